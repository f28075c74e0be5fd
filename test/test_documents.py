# SPDX-License-Identifier: Apache-2.0
"""Documents agree with the code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.documents import PAGES, commands
from musculoskeletal_ae.robot.robot import Robot

ROOT = Path(__file__).resolve().parent.parent
DOC = ROOT / 'doc'
REMEDY = 'run: python doc/make.py'
sys.path.insert(0, str(DOC))
import make  # noqa: E402 - the script that generates pages

#: generated pages that are compared in full. Generating command_line.md starts a process for each
#: executable, which takes too long for a test.
GENERATED = ('api.md', 'parameters.md', 'stops.md')


@pytest.mark.parametrize('page', GENERATED)
def test_a_generated_page_is_up_to_date(page):
    assert (DOC / 'reference' / page).read_text('utf-8') == make.PAGES[page](), REMEDY


def test_the_page_of_public_classes_names_nothing_private():
    assert '`_' not in make.api()


def test_the_page_of_the_command_line_has_every_executable_and_option():
    page = (DOC / 'reference' / 'command_line.md').read_text('utf-8')
    setup = (ROOT / 'setup.py').read_text('utf-8')
    names = re.findall(r'^[A-Z_]+ = \[(.*?)\]$', setup, re.M)
    for name in re.findall(r"'(\w+)'", ', '.join(names)):
        assert f'\n## {name}\n' in page, REMEDY
    usage = subprocess.run(
        [ROOT / 'bringup.sh', '--help'], capture_output=True, text=True, check=True
    ).stdout
    assert usage.rstrip() in page, REMEDY


@pytest.mark.parametrize('document', make.DOCUMENTS, ids=lambda document: document.name)
def test_the_tables_of_a_document_are_those_of_the_committed_results(document):
    text = document.read_text('utf-8')
    assert text == make.with_tables(text), REMEDY


def test_links_between_documents_lead_somewhere():
    files = [*ROOT.glob('*.md'), *DOC.rglob('*.md'), *ROOT.glob('*/README.md')]
    broken = []
    for file in files:
        for target in re.findall(r'\]\(([^)\s]+)\)', file.read_text('utf-8')):
            if re.match('[a-z]+:', target):
                continue
            path, _, anchor = target.partition('#')
            page = Path(os.path.normpath(file.parent / path)) if path else file
            if not page.exists():
                broken.append(f'{file.relative_to(ROOT)}: {target}')
            elif anchor and page.suffix == '.md':
                headings = re.findall(r'^#+ (.*)$', page.read_text('utf-8'), re.M)
                anchors = {re.sub(r'[^\w\- ]', '', h.lower()).replace(' ', '-') for h in headings}
                if anchor not in anchors:
                    broken.append(f'{file.relative_to(ROOT)}: {target}')
    assert not broken


def test_every_page_is_at_most_two_clicks_from_the_readme():
    reached = {ROOT / 'README.md'}
    for _ in range(2):
        links = {
            Path(os.path.normpath(page.parent / target.partition('#')[0]))
            for page in reached
            for target in re.findall(r'\]\(([^)\s]+)\)', page.read_text('utf-8'))
            if not re.match('[a-z]+:', target) and not target.startswith('#')
        }
        reached |= {page for page in links if page.suffix == '.md'}
    pages = {page for page in DOC.rglob('*.md') if 'modules' not in page.parts}  # made by Sphinx
    assert pages - reached == {DOC / 'results' / 'recordings' / 'tables.md'}


def test_the_files_that_documents_and_docstrings_name_exist():
    package = ROOT / 'musculoskeletal_ae'
    files = [*DOC.glob('explanation/*.md'), ROOT / 'CONTRIBUTING.md', *package.rglob('*.py')]
    missing = []
    for file in files:
        names = re.findall(r'`([a-z_]\w*/[\w/]+\.py)`', file.read_text('utf-8'))
        missing += [
            f'{file.relative_to(ROOT)}: {name}'
            for name in names
            if not any((folder / name).exists() for folder in (package, ROOT, file.parent))
        ]
    assert not missing


def test_the_table_of_each_folder_names_its_own_files():
    text, missing = (DOC / 'explanation' / 'architecture.md').read_text('utf-8'), []
    for part in re.split(r'^(?=\*\*`)|^#', text, flags=re.M):
        if (folder := re.match(r'\*\*`([\w/]+)/`\*\*', part)) is None:
            continue
        first_cells = ' '.join(re.findall(r'^\|([^|]*)\|', part, re.M))
        missing += [
            f'{folder[1]}: {name}'
            for name in re.findall(r'`([\w/]+\.py)`', first_cells)
            if not (ROOT / 'musculoskeletal_ae' / folder[1] / name).exists()
        ]
    assert not missing


def test_the_python_of_the_tutorial_estimates_without_ros(trained_file, tmp_path):
    page = (DOC / 'tutorials' / 'python_without_ros.md').read_text('utf-8')
    (block,) = re.findall(r'```python\n(.*?)```', page, re.S)
    # The rest of the block applies the function to a recording of another robot.
    lines = block.partition('recording = ')[0].replace('musashi_left_arm', 'arm26')
    (tmp_path / 'arm.safetensors').write_bytes(Path(trained_file).read_bytes())
    robot = Robot.load('arm26')
    theta = 0.5 * (robot.lower + robot.upper)
    tension = np.full(robot.muscle_count, 80.0)
    length = robot.muscle_lengths(theta, tension)
    program = f"""
import sys
sys.modules['rclpy'] = None
import numpy as np
{lines}
print(*joint_angles(np.array({tension.tolist()}), np.array({length.tolist()})))
"""
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    estimated = np.array(done.stdout.split(), dtype=float)
    # After this brief training, networks have errors below 0.1 rad on their own geometry.
    assert np.linalg.norm(estimated - theta) < 0.3


def test_commands_of_a_page_are_read_as_a_reader_would_run_them(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text(
        '```sh\n'
        './bringup.sh --view      # look; Ctrl-C ends it\n'
        '# a comment\n'
        'ros2 topic pub "{a: 1,\n  b: 2}"   # both\n'
        '```\n'
        '1. Item\n\n'
        '   <!-- bench: skip needs hardware -->\n'
        '   ```sh\n   one \\\n      two\n   ```\n'
        '```python\nnot_a_command()\n```\n',
        encoding='utf-8',
    )
    assert commands(page) == [
        ('./bringup.sh --view', True, ''),
        ('ros2 topic pub "{a: 1, b: 2}"', False, ''),
        ('one  two', False, 'needs hardware'),
    ]


INSTALLED = ROOT / '.venv' / '.installed'


@pytest.mark.skipif(
    not INSTALLED.exists() or not INSTALLED.read_text('utf-8').splitlines()[0].endswith(f' {ROOT}'),
    reason='.venv was not installed by the scripts of this repository',
)
def test_a_terminal_that_the_documents_prepare_runs_the_executables():
    program = '. ./terminal.sh >&2 && "$bin/render" --help'
    done = subprocess.run(
        ['bash', '-c', program], cwd=ROOT, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert 'usage' in done.stdout.lower()


def test_options_and_executables_that_the_documents_name_exist():
    bringup = (ROOT / 'bringup.sh').read_text('utf-8')
    setup = (ROOT / 'setup.py').read_text('utf-8')
    lines = [command.line for page in PAGES for command in commands(ROOT / page)]
    assert len(lines) > 50
    for line in lines:
        if line.startswith('./bringup.sh'):
            for option in re.findall(r' (--[\w-]+)', line):
                assert f'{option} ' in bringup, line
        for name in re.findall(r'(?:\$bin/|ros2 run musculoskeletal_ae )([\w.]+)', line):
            assert f"'{name}'" in setup, line


def test_parameters_that_the_documents_name_exist():
    parameters = (ROOT / 'config' / 'nodes.yaml').read_text('utf-8')
    text = ''.join((ROOT / page).read_text('utf-8') for page in PAGES)
    named = re.findall(r'ros2 param set /\w+ (\w+)', text)
    named += re.findall(r' -p \w+:(\w+):=', text)
    assert named
    assert all(f' {name}: ' in parameters for name in named)


#: part of a command that names the new file or directory which it makes
MAKES = re.compile(
    r'(?:\brecord (?!-)|\bcp (?:-r )?\S+ |\bgit clone .*\S+ |\bmkdir (?:-p )?'
    r'|--(?:record|recover \S+|out|plot|keep|page) |-o |state_directory:=| > )([\w./]+)'
)


def test_no_two_commands_of_the_documents_write_to_the_same_place():
    makers = {}
    folders = DOC, *(ROOT / name for name in ('bags', 'bench', 'config', 'examples'))
    for page in (*ROOT.glob('*.md'), *(file for each in folders for file in each.rglob('*.md'))):
        for command in commands(page):
            if command.line.startswith('[ -d '):  # this command does not replace what exists
                continue
            for made in MAKES.findall(command.line):
                makers.setdefault(made.rstrip('/'), []).append((page.name, command.line))
    assert {place: pages for place, pages in makers.items() if len(pages) > 1} == {}


def test_commands_that_play_a_recording_with_an_isolation_do_not_stop_at_the_anomaly():
    pages = [*PAGES, 'bags/README.md']
    played = [
        command.line
        for page in dict.fromkeys(pages)
        for command in commands(ROOT / page)
        if 'bags/isolation' in command.line and 'bringup.sh' in command.line
    ]
    assert played
    assert all('-p estimator:on_anomaly:=isolate' in line for line in played)


def test_messages_that_the_documents_publish_once_are_not_lost():
    """Without `--keep-alive`, `ros2 topic pub` may end before a node has discovered it."""
    lines = [command.line for page in PAGES for command in commands(ROOT / page)]
    published = [line for line in lines if line.startswith('ros2 topic pub ')]
    assert published
    assert all(' --once --keep-alive 3 ' in line for line in published)


def test_every_symbol_that_the_audit_of_the_paper_names_exists():
    text = (ROOT / 'notes' / 'paper_audit.md').read_text('utf-8')
    rows = re.findall(r'^\| (\d+) \|.*\| (exact|open|deviation) \|$', text, re.M)
    assert [int(number) for number, _ in rows] == list(range(1, 111))
    named = re.findall(r'`([\w/]+\.py):(\w+)`', text)
    assert len(named) > 90
    for file, symbol in named:
        source = (ROOT / 'musculoskeletal_ae' / file).read_text('utf-8')
        defined = rf'^\s*(?:def|class) {symbol}\b|^(?:[A-Z_]+, )*{symbol}\b[^\n]*='
        assert re.search(defined, source, re.M), f'{file}:{symbol}'
