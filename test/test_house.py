# SPDX-License-Identifier: Apache-2.0
"""Rules of the whole repository, and the linters of a sourced Jazzy."""

import ast
import re
import subprocess
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 'musculoskeletal_ae'
ROS = re.compile(r'(rclpy|rcl_interfaces|\w+_msgs|\w+_srvs|builtin_interfaces)(\.|$)')
DOCUMENT = re.compile(r'(?<![\w/])(?:doc|config|bags|bench|notes)/[\w./-]+\.\w+')


def sources(*folders: Path) -> list[Path]:
    return sorted(file for folder in folders for file in folder.rglob('*.py'))


class Imports(NamedTuple):
    """Names of the modules that a Python file imports."""

    names: set[str]  # modules as they are named in import statements
    #: all modules, and names within modules, that the file may import when it runs, which excludes
    #: imports for annotations alone
    at_run_time: set[str]


@cache
def imports(file: Path) -> Imports:
    names, at_run_time = set[str](), set[str]()
    tree = ast.parse(file.read_text(encoding='utf-8'))
    open_nodes: list[tuple[ast.AST, bool]] = [(tree, True)]
    while open_nodes:
        node, runs = open_nodes.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING':
            runs = False
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            if runs:
                whole = {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
                at_run_time |= whole
        elif isinstance(node, ast.Import):
            named = {alias.name for alias in node.names}
            names |= named
            at_run_time |= named if runs else set()
        open_nodes += ((child, runs) for child in ast.iter_child_nodes(node))
    return Imports(names, at_run_time)


SPEAKING_ROS = ('nodes', 'ros', 'ros_tools')


def test_only_nodes_and_tools_of_the_graph_import_ros() -> None:
    outside = [file for file in sources(PACKAGE) if file.parent.name not in SPEAKING_ROS]
    assert len(outside) > 40
    speaking = {str(file): sorted(filter(ROS.match, imports(file).names)) for file in outside}
    assert not {file: names for file, names in speaking.items() if names}


def test_no_module_imports_itself_in_a_circle() -> None:
    # Imports within functions count as well, but imports for annotations alone do not.
    modules = {'.'.join(f.relative_to(ROOT).with_suffix('').parts): f for f in sources(PACKAGE)}
    graph = {name: imports(file).at_run_time & set(modules) for name, file in modules.items()}
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


def test_only_the_presets_import_the_paper() -> None:
    chosen = 'paper', 'presets'
    for file in sources(PACKAGE):
        if file.parent.name not in chosen:
            taken = [
                name for name in imports(file).names if name.startswith(f'{PACKAGE.name}.paper')
            ]
            assert not taken, f'{file}: choose it through presets.registry instead'


def test_outside_its_folder_the_paper_is_only_cited() -> None:
    # Folders that implement the paper or compare with it, files whose options name its preset, and
    # the file that names the folders whose code determines an initial network.
    chosen = 'paper', 'presets', 'experiments'
    offered = (
        'parameters.py',
        'declared_parameters.py',
        'train.py',
        'experiment.py',
        'network_cache.py',
    )
    for file in sources(PACKAGE):
        if file.parent.name in chosen or file.name in offered:
            continue
        text = ' '.join(file.read_text(encoding='utf-8').split())
        for match in re.finditer('paper', text, re.IGNORECASE):
            around = text[match.start() : match.end() + 50]
            assert '§' in around, f'{file}: cite the section, or choose by a preset: {around}'


def test_one_file_uses_what_rclpy_does_not_publish() -> None:
    taking = [
        file.name
        for room in SPEAKING_ROS
        for file in sources(PACKAGE / room)
        if any('rclpy.impl' in n for n in imports(file).names)
        or re.search(r"(get|has)attr\(\w+, '_[a-z]", file.read_text(encoding='utf-8'))
    ]
    assert taking == ['executor.py']


def test_the_core_never_imports_the_nodes_or_the_tools() -> None:
    for file in sources(PACKAGE):
        if file.parent.name not in (*SPEAKING_ROS, 'tools') and file.name != 'executables.py':
            upward = [
                n
                for n in imports(file).names
                if re.match(r'musculoskeletal_ae\.(nodes|ros|ros_tools|tools)\b', n)
            ]
            assert not upward, file


def test_the_foreign_emulator_shares_no_code_with_the_first_one_or_the_learner() -> None:
    model = r'(learning|estimation|mae)\b|robot\.(routes|series_elastic|wrapping)'
    for file in sources(PACKAGE / 'emulator' / 'foreign'):
        pattern = rf'musculoskeletal_ae\.(emulator\.kin\b|{model})'
        assert not [n for n in imports(file).names if re.match(pattern, n)], file
        if file.name != 'deviation.py':  # it only scales the sizes that it draws by moment arms
            assert 'robot.routes' not in file.read_text(encoding='utf-8'), file


def test_every_source_file_names_its_licence() -> None:
    for file in sources(PACKAGE, ROOT / 'test', ROOT / 'bench', ROOT / 'bags'):
        assert '# SPDX-License-Identifier: Apache-2.0' in file.read_text(encoding='utf-8')[:120], (
            file
        )


def test_every_document_that_code_cites_is_in_the_repository() -> None:
    tracked = subprocess.run(
        ['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    cited = {
        (match, file.name)
        for file in [*sources(PACKAGE, ROOT / 'bench'), *ROOT.glob('*.md'), *ROOT.glob('doc/*.md')]
        for match in DOCUMENT.findall(file.read_text(encoding='utf-8'))
    }
    assert cited
    missing = {(name, by) for name, by in cited if name not in tracked}
    assert not missing


# -- linters of ROS 2: not among the ROS wheels of PyPI, so they need a sourced Jazzy ------------


def test_ament_flake8() -> None:
    main = pytest.importorskip('ament_flake8.main', reason='only a sourced Jazzy has it')
    config = str(ROOT / 'test' / 'ament_flake8.ini')
    status, errors = main.main_with_errors(
        argv=['--config', config, *map(str, (PACKAGE, ROOT / 'test', ROOT / 'bench'))]
    )
    assert status == 0, '\n'.join(errors)


def test_ament_pep257() -> None:
    main = pytest.importorskip('ament_pep257.main', reason='only a sourced Jazzy has it')
    options = ['--convention', 'google', '--add-ignore', 'D105', 'D107', 'D402']
    assert main.main([str(PACKAGE), *options]) == 0


def test_ament_copyright() -> None:
    # ament_copyright does not know short SPDX headers, which a test above checks. Let it judge the
    # licence and the terms of contributions.
    parser = pytest.importorskip('ament_copyright.parser', reason='only a sourced Jazzy has it')
    for kind, name in (
        ('LicenseDescriptor', 'LICENSE'),
        ('ContributingDescriptor', 'CONTRIBUTING.md'),
    ):
        file = getattr(parser, kind)(str(ROOT / name))
        file.parse()
        assert file.license_identifier == 'apache2', name


def test_ament_xmllint(capfd: pytest.CaptureFixture[str]) -> None:
    main = pytest.importorskip('ament_xmllint.main', reason='only a sourced Jazzy has it')
    status = main.main([str(ROOT / 'package.xml')])
    if 'failed to load external entity' in capfd.readouterr().err:
        pytest.skip('the schema of package.xml is on download.ros.org, which is out of reach')
    assert status == 0
