# SPDX-License-Identifier: Apache-2.0
"""What the documents say is so."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from musculoskeletal_ae.control import stops_page
from musculoskeletal_ae.robot.robot import Robot

ROOT = Path(__file__).resolve().parent.parent


def test_the_page_of_public_classes_is_up_to_date():
    sys.path.insert(0, str(ROOT / 'doc'))
    import make

    page = make.api()
    assert '`_' not in page  # what is private is nothing to build on
    assert (ROOT / 'doc' / 'reference' / 'api.md').read_text('utf-8') == page, (
        'run: python doc/make.py'
    )


def test_the_page_of_stops_is_up_to_date():
    remedy = 'run: python -m musculoskeletal_ae.control.stops_page > doc/reference/stops.md'
    assert (ROOT / 'doc' / 'reference' / 'stops.md').read_text('utf-8') == stops_page.page(), remedy


def test_the_three_lines_of_python_of_the_readme_estimate_without_ros(trained_file, tmp_path):
    readme = (ROOT / 'README.md').read_text('utf-8')
    (lines,) = re.findall(r'```python\n(.*?)```', readme, re.S)
    assert len(list(filter(None, lines.splitlines()))) == 3
    (tmp_path / 'arm.safetensors').write_bytes(Path(trained_file).read_bytes())
    robot = Robot.load('arm26')
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, 80.0)
    length = robot.muscle_lengths(theta, tension)
    program = f"""
import sys
sys.modules['rclpy'] = None
import numpy as np
tension, length = np.array({tension.tolist()}), np.array({length.tolist()})
{lines}
print(*theta)
"""
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    estimated = np.array(done.stdout.split(), dtype=float)
    # Networks of this brief training are within 0.1 rad on their own geometry.
    assert np.linalg.norm(estimated - theta) < 0.3


def test_options_and_executables_that_the_guide_names_exist():
    guide = (ROOT / 'doc' / 'howto' / 'your_robot.md').read_text('utf-8')
    bringup = (ROOT / 'bringup.sh').read_text('utf-8')
    for option in set(re.findall(r'bringup\.sh[^\n]*? (--[\w-]+)', guide)):
        assert f'{option} ' in bringup
    setup = (ROOT / 'setup.py').read_text('utf-8')
    used = set(re.findall(r'\$bin/(\w+) ', guide))
    assert {'check_robot', 'check_driver'} <= used
    assert all(f"'{name}'" in setup for name in used)
    parameters = (ROOT / 'config' / 'nodes.yaml').read_text('utf-8')
    for name in ('rate_limit', 'first_duration', 'max_age', 'temperature_limit', 'relearn_muscles'):
        assert f'`{name}' in guide and f'{name}: ' in parameters
