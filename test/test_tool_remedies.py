# SPDX-License-Identifier: Apache-2.0
"""Each advice that a tool prints is followed in the situation that prints it.

These tools need no graph of ROS. EXCEPTIONS names where the others are tried.
"""

import re
import socket
from argparse import Namespace
from contextlib import closing
from itertools import count
from pathlib import Path
from shutil import copytree

import pytest
from remedies import check_remedy, members
from robots import copy_robot

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.experiments.measurement import _work_folder
from musculoskeletal_ae.experiments.results import BEGIN, END, text_around_table, write_report
from musculoskeletal_ae.experiments.study import Study
from musculoskeletal_ae.figures import save_figure
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.simulation.simulation import Simulation
from musculoskeletal_ae.tools import experiment
from musculoskeletal_ae.tools.fit_series_elastic import fit
from musculoskeletal_ae.tools.model_training import prepare
from musculoskeletal_ae.tools.network_cache import _cache_directory

ROOT = Path(__file__).resolve().parents[1]
TABLE = [
    line.split(',')
    for line in (ROOT / 'config/testbed/one_muscle.csv').read_text().splitlines()
    if line[0].isdigit()
]
HEADER = 'tension,absolute_length,elongation'
#: where the advice of tools is followed that need a graph of ROS: by module, file and test. Not
#: followed is the advice to wait longer, or for a less busy computer (ros_tools/taught_motion.py).
EXCEPTIONS = {
    'ros_tools/render.py': ('nodes/test_markers.py', 'test_render_draws_the_emulated_arm'),
    'ros_tools/replay.py': (
        'bags/test_record_and_replay.py',
        'test_a_paused_replay_steps_resumes_and_loops_its_clock',
    ),
    'ros_tools/lockstep.py': (
        'bags/test_record_and_replay.py',
        'test_a_replay_begins_when_the_nodes_run_that_it_waits_for',
    ),
    'ros_tools/taught_motion.py': (
        'bags/test_record_and_replay.py',
        'test_a_demonstration_is_replayed_as_one_trajectory',
    ),
    'ros_tools/check_driver.py': (
        'nodes/test_check_driver.py',
        'test_check_driver_does_not_move_an_arm_under_control',
    ),
}


def rows(change=lambda cells: cells, header=HEADER):
    """Return the shipped table with changed rows."""
    return '\n'.join([header, *(','.join(map(str, change(cells))) for cells in TABLE)])


def in_mm(*columns):
    return lambda cells: [1e3 * float(v) if k in columns else v for k, v in enumerate(cells)]


def first(count):
    return '\n'.join(rows().splitlines()[: count + 1])


TABLES = {
    'columns': (rows(header='T,l,e'), 'expected the columns (.*), got',
                [lambda match: rows(header=match[1])]),
    'no number': (rows().replace('0.00165', '1,65'), 'expected 3 finite numbers', [rows()]),
    'negative tension': (rows().replace('\n5,', '\n-5,'), 'expected tension >= 0', [rows()]),
    'length in mm': (rows(in_mm(1, 2)), 'divide lengths in mm by 1000', [rows()]),
    'elongation in mm': (rows(in_mm(2)), 'divide lengths in mm by 1000', [rows()]),
    'sign of elongation': (
        rows(lambda cells: [*cells[:2], -float(cells[2])]),
        'state how much longer the muscle is than at 0 N', [rows()],
    ),
    'sign of small elongations': (
        rows(lambda cells: [*cells[:2], -0.01 * float(cells[2])]), 'check its sign',
        [rows(lambda cells: [*cells[:2], 0.01 * float(cells[2])])],
    ),
    'exchanged rows': (
        rows(lambda cells: [505.0 - float(cells[0]), *cells[1:]]),
        'that each row has the elongation at its own tension', [rows()],
    ),
    'few rows': (first(3), 'needs at least 4 rows', [rows()]),
    'one length': (first(6), 'needs several tensions at several muscle lengths', [first(12)]),
}  # fmt: skip


@pytest.mark.parametrize('name', TABLES)
def test_a_table_of_a_testbed_is_fitted_after_the_advice(name, tmp_path, capsys):
    def use(text):
        (tmp_path / 'table.csv').write_text(text)
        fit(Namespace(table=tmp_path / 'table.csv', plot=None))
        assert 'series_elastic: {' in capsys.readouterr().out

    check_remedy(use, *TABLES[name])


def test_outputs_are_written_where_the_refusals_say(tmp_path):
    (tmp_path / 'file').write_text('')

    def use(out):
        prepare(Namespace(out=out, plot=None, device='cpu', robot='arm26'))

    for bad in tmp_path, tmp_path / 'none' / 'a.safetensors':
        ways = [tmp_path / 'a.safetensors']
        check_remedy(use, bad, 'expected a file in an existing directory', ways)
    long = tmp_path / ('a' * 254)
    check_remedy(use, long, 'choose another file', [tmp_path / 'b.safetensors'])


def test_a_cache_is_found_after_the_home_was_named(tmp_path, monkeypatch):
    def use(variables):
        with pytest.MonkeyPatch.context() as patch:
            patch.delenv('XDG_CACHE_HOME', raising=False)
            for name, value in variables.items():
                patch.setenv(name, value)
            assert _cache_directory()

    monkeypatch.setattr(Path, 'expanduser', without_a_home)
    advice = 'set (HOME), or (XDG_CACHE_HOME) to a directory'
    ways = [lambda match: {match[1]: str(tmp_path)}, lambda match: {match[2]: str(tmp_path)}]
    check_remedy(use, {'HOME': ''}, advice, ways)


def without_a_home(path):
    """Expand ~ as for a user who is not in the list of users."""
    import os

    home = os.environ.get('HOME', '')
    if str(path).startswith('~') and not home:
        raise RuntimeError('Could not determine home directory.')
    return Path(str(path).replace('~', home, 1))


# -- experiment -----------------------------------------------------------------------------------


def test_a_folder_of_kept_parts_is_used_as_the_refusals_say(tmp_path):
    def use(change):
        options = {'robot': 'arm26', 'preset': 'default', 'minutes': 1.0, 'quick': True}
        with _work_folder(
            Namespace(**{**options, 'reality': 'kin', 'keep': tmp_path / 'a'} | change)
        ):
            pass

    use({})
    check_remedy(
        use,
        {'minutes': 2.0},
        r'\(.*minutes ([\d.]+),.*\); use these options again, or name an empty folder',
        [lambda match: {'minutes': float(match[1])}, {'minutes': 2.0, 'keep': tmp_path / 'b'}],
    )
    (tmp_path / 'c').mkdir()
    (tmp_path / 'c' / 'file').write_text('')
    check_remedy(
        use,
        {'keep': tmp_path / 'c'},
        'expected an empty or new folder',
        [{'keep': tmp_path / 'd'}],
    )


def test_a_part_that_cannot_be_used_is_measured_again_after_its_removal(tmp_path):
    study = Study(Robot.load('arm26'), 'default', (0,), 1.0, True, tmp_path)
    (tmp_path / 'part.npz').write_bytes(b'damaged')

    def use(file):
        if file is not None:
            file.unlink()
        assert study.remember('part', lambda: {'a': 1.0}) == {'a': 1.0}

    advice = r'^(\S+) is no kept part .*; remove it, and the next run measures this part again'
    check_remedy(use, None, advice, [lambda match: Path(match[1])])


def test_a_page_gets_its_table_after_the_markers_were_added(tmp_path):
    def use(text):
        (tmp_path / 'README.md').write_text(text)
        text_around_table(tmp_path / 'README.md')

    advice = f'expected the lines ({BEGIN}) and ({END}), once each and in this order'
    ways = [lambda match: f'a\n{match[1]}\n{match[2]}\n']
    for bad in '', BEGIN, f'{END}{BEGIN}', f'{BEGIN}{END}' * 2:
        check_remedy(use, bad, advice, ways)


def test_a_report_is_written_to_an_empty_folder_as_the_refusal_says(tmp_path):
    damaged, empty = tmp_path / 'damaged', tmp_path / 'empty'
    copytree(ROOT / 'doc/results/control', empty / 'control')  # what a run writes there
    (damaged / 'control').mkdir(parents=True)
    about = (
        '{"about": {"robot": "arm26", "preset": "default", "reality": "kin", "minutes": 1.0, '
        '"quick": true, "seeds": [0]}, "seeds": {"0": {}}}'
    )
    (damaged / 'control' / 'result.json').write_text(about)
    check_remedy(write_report, damaged, 'use an empty output folder', [empty])


def test_the_command_that_makes_the_page_of_the_paper_is_one_of_the_tool(tmp_path, monkeypatch):
    from musculoskeletal_ae.experiments import measurement
    from musculoskeletal_ae.experiments.paper_page import text

    with pytest.raises(MusculoskeletalError) as refused:
        text({}, tmp_path / 'paper')
    command = re.search('first run: experiment (.*)$', str(refused.value))[1].split(' ')
    called = []
    monkeypatch.setattr(measurement, 'measure', lambda args: called.append(args.page))
    assert experiment.main([*command, '--out', str(tmp_path / 'out')]) == 0
    assert called == [tmp_path / 'paper.md']


# -- simulation, pictures, page -------------------------------------------------------------------


def test_the_least_number_of_simulated_arms_is_named(trained):
    robot = Robot.load('arm26')
    check_remedy(
        lambda arms: Simulation(robot, trained['default'], arms=arms),
        0,
        r'arms: expected at least (\d+)',
        [lambda match: int(match[1])],
    )


def test_a_picture_is_saved_in_another_place(tmp_path):
    from matplotlib.figure import Figure

    check_remedy(
        lambda file: save_figure(Figure(), file),
        tmp_path / 'none' / 'a.png',
        'cannot be written: .*No such file or directory',
        [tmp_path / 'a.png'],
    )


def test_a_mesh_is_drawn_in_each_format_that_the_note_names(tmp_path):
    trimesh = pytest.importorskip('trimesh')
    from musculoskeletal_ae.view.body import link_solids

    box, numbers = trimesh.creation.box((1.0, 1.0, 1.0)), count()

    def use(ending):
        folder = copy_robot('arm26', tmp_path / f'arm{next(numbers)}')
        file = folder / f'box{ending}'
        file.write_bytes(b'' if ending == '.dae' else exported(box, ending))
        urdf = folder / 'robot.urdf'
        name = '<link name="upper_arm">'
        mesh = f'<visual><geometry><mesh filename="{file.name}"/></geometry></visual>'
        urdf.write_text(urdf.read_text().replace(name, name + mesh))
        _, notes = link_solids(Robot.load(folder))
        if notes:
            raise MusculoskeletalError(notes[0])

    check_remedy(use, '.dae', r'cannot be drawn; legal: (\.\w+(?:, \.\w+)*)', members())


def exported(mesh, ending):
    data = mesh.export(file_type=ending[1:])
    return data.encode() if isinstance(data, str) else data


def test_a_page_is_served_at_another_port_as_the_refusal_says():
    pytest.importorskip('viser')
    from musculoskeletal_ae.view.page import Page

    robot = Robot.load('arm26')
    with closing(socket.create_server(('127.0.0.1', 0))) as taken:
        free = socket.create_server(('127.0.0.1', 0))
        ports = [each.getsockname()[1] for each in (taken, free)]
        free.close()
        check_remedy(
            lambda port: Page(robot, '127.0.0.1', port, False, lambda *_: None).close(),
            ports[0],
            'choose another --port or --host',
            [ports[1]],
        )


def test_what_tools_tell_to_install_is_in_the_file_that_they_name():
    """Installing takes minutes, so this reads the file instead."""
    listed = (ROOT / 'requirements.txt').read_text()
    assert re.search('^viser==', listed, re.MULTILINE)
    assert re.search('^mujoco==', listed, re.MULTILINE)


def test_the_places_where_other_tools_are_tried_exist():
    for module, (file, test) in EXCEPTIONS.items():
        assert (ROOT / 'musculoskeletal_ae' / module).is_file()
        assert f'def {test}' in (ROOT / 'test' / file).read_text()
