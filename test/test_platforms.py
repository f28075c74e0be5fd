# SPDX-License-Identifier: Apache-2.0
"""The core and one node on other interpreters, if CI requests it; see bench/platforms.py."""

import os
import shutil

import pytest

from bench import platforms

VARIABLE = 'MUSCULOSKELETAL_AE_PLATFORMS'  # lists versions of Python, such as "3.12 3.13"
VERSIONS = os.environ.get(VARIABLE, '').split()


@pytest.mark.skipif(not VERSIONS, reason=f'{VARIABLE} names no version of Python')
@pytest.mark.parametrize('version', VERSIONS)
def test_the_core_and_a_node_work_on_another_interpreter(version, trained_files, tmp_path):
    if platforms.interpreter(version) is None:
        pytest.skip(f'there is no python{version}')
    try:
        line = platforms.check_node(f'wheels-{version}', tmp_path, trained_files['default'])
    finally:
        shutil.rmtree(tmp_path)  # 650 MB, which pytest would keep
    assert f'Python {version}.' in line


def test_pins_of_a_requirements_file_are_chosen_by_interpreter(tmp_path):
    file = tmp_path / 'requirements.txt'
    file.write_text("# pins\na==1; python_version < '3.11'\na==2; python_version >= '3.11'\nb==3\n")
    assert platforms.pinned(file, '3.10') == ['a==1', 'b==3']
    assert platforms.pinned(file, '3.12', ('a',)) == ['a==2']
