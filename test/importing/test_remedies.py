# SPDX-License-Identifier: Apache-2.0
"""Each advice of `import_robot` is followed with the file that caused it.

A row has the changes of the files that cause the refusal, the advice, and the changes that follow
it, each in a folder of its own. A change gets the folder and the match of the advice. It returns
the name of the file to import if the advice names another one.
"""

from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple

import bodies
import pytest
from remedies import Members, check_remedy, listed

from musculoskeletal_ae.importing.convert import import_robot, read_source
from musculoskeletal_ae.importing.source import cut


class Row(NamedTuple):
    """A refusal, and its advice with the changes that follow it."""

    file: str  # the file that is imported
    breaks: tuple[Callable[[Path], object], ...]
    advice: str
    mends: tuple[object, ...]


def changed(name, old, new):
    def change(folder, _=None):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def added(name, text):
    return lambda folder, _=None: (folder / name).write_text(text)


def removed(name):
    return lambda folder, _=None: (folder / name).unlink()


def in_order(*changes):
    def change(folder, match=None):
        for each in changes:
            each(folder, match)

    return change


URDF = bodies.URDF.format(mimic='')
AS_SDF = removed('model.urdf'), added('model.sdf', bodies.SDF)
PART = '<mujocoinclude><site name="extra"/></mujocoinclude>'
INCLUDED = changed('own.xml', '<site name="hole"', '<include file="part.xml"/><site name="hole"')
SECOND_ARM = '<link name="arm"><inertial><mass>1</mass></inertial></link>'
UNDER_LIMITS = 'expected a list of at least 2 different finite numbers .rad. for each joint'
ROWS = {
    'included file that is none': Row(
        'own.xml', (INCLUDED, lambda folder, _=None: (folder / 'part.xml').mkdir()),
        "the included file 'part.xml' is not a regular file",
        (in_order(lambda folder, _=None: (folder / 'part.xml').rmdir(), added('part.xml', PART)),),
    ),
    'sdf itself': Row(
        'model.sdf', AS_SDF,
        'to import an SDF, pass the path of the (cardsflow.xml) in its directory instead',
        (lambda _, match: match[1],),
    ),
    'model is missing': Row(
        'cardsflow.xml', (removed('model.urdf'),), 'contains neither (model.urdf) nor (model.sdf)',
        (lambda folder, match: added(match[1], URDF)(folder),
         lambda folder, match: added(match[2], bodies.SDF)(folder)),
    ),
    'link of a muscle': Row(
        'cardsflow.xml', (changed('cardsflow.xml', 'name="base"', 'name="bass"'),),
        "unknown link 'bass'; links: (.*)$",
        (Members(lambda link: changed('cardsflow.xml', 'name="bass"', f'name="{link}"')),),
    ),
    'limits of no joint': Row(
        'cardsflow.xml', (added('joint_limits.yaml', '[1]'),), UNDER_LIMITS,
        (added('joint_limits.yaml', 'shoulder: [-0.5, 0.5]'),),
    ),
    'one limit': Row(
        'cardsflow.xml', (added('joint_limits.yaml', 'shoulder: [1, 1]'),), UNDER_LIMITS,
        (added('joint_limits.yaml', 'shoulder: [0, 1]'),),
    ),
    'joint of a mimic': Row(
        'model.urdf', (added('model.urdf', bodies.URDF.format(mimic='<mimic joint="moon"/>')),),
        "a joint mimics 'moon', but there is no such joint",
        (changed('model.urdf', '"moon"', '"shoulder"'),
         changed('model.urdf', '<mimic joint="moon"/>', '')),
    ),
    'frames of SDF 1.7': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '<pose>0 0 0.1',
                                           '<pose relative_to="base">0 0 0.1')),
        'only SDF 1.6 is supported, with angles in radians, and without (relative_to), ',
        (lambda folder, match: changed('model.sdf', f' {match[1]}="base"', '')(folder),),
    ),
    'degrees': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '<pose>0 0 0.1',
                                           '<pose degrees="true">0 0 0.1')),
        'only SDF 1.6 is supported, with angles in radians',
        (changed('model.sdf', ' degrees="true"', ''),),
    ),
    'two models': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '</model>',
                                           '<model name="palm"/></model>')),
        'expected a single <model> without <include>; merge all models into one',
        (changed('model.sdf', '<model name="palm"/>', ''),),
    ),
    'no model': Row(
        'cardsflow.xml', (removed('model.urdf'), added('model.sdf', '<sdf version="1.6"/>')),
        'expected an <sdf> element with a <model>', (added('model.sdf', bodies.SDF),),
    ),
    'link twice': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '<joint', f'{SECOND_ARM}<joint')),
        'expected unique names: rename one',
        (in_order(changed('model.sdf', f'{SECOND_ARM}<joint', SECOND_ARM.replace(
            '"arm"', '"more"') + '<joint name="j" type="fixed"><parent>arm</parent>'
            '<child>more</child></joint><joint')),),
    ),
    'two roots': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '<joint', '<link name="more"/><joint')),
        'expected a tree of links with one root; outside it: ',
        (changed('model.sdf', '<link name="more"/>', ''),),
    ),
    'number': Row(
        'cardsflow.xml', (*AS_SDF, changed('model.sdf', '<mass>2', '<mass>2,0')),
        'expected 1 finite numbers', (changed('model.sdf', '<mass>2,0', '<mass>2.0'),),
    ),
    'another format': Row(
        'own.xml', (added('own.xml', '<html/>'),), 'legal: (mujoco, cardsflow, robot);',
        (added('own.xml', bodies.MJCF), added('own.xml', URDF), added('own.xml', bodies.CARDSFLOW)),
    ),
    'xacro': Row(
        'model.urdf', (changed('model.urdf', '<mass value="2"/>', '<mass value="${1 + 1}"/>'),),
        'expand it to a new file first:  xacro FILE > NEW.urdf',
        # test_description_remedies.py runs xacro
        (changed('model.urdf', '${1 + 1}', '2'),),
    ),
}  # fmt: skip


def files(folder):
    folder.mkdir()
    added('own.xml', bodies.MJCF)(folder)
    added('cardsflow.xml', bodies.CARDSFLOW)(folder)
    added('model.urdf', URDF)(folder)
    return folder


@pytest.mark.parametrize('name', ROWS)
def test_a_file_can_be_imported_after_its_advice(name, tmp_path):
    row, numbers = ROWS[name], count()

    def use(change):
        folder = files(tmp_path / str(next(numbers)))
        for each in row.breaks:
            each(folder)
        named = change(folder)
        cut(read_source(folder / (named if isinstance(named, str) else row.file)))

    def in_folder(change, match):
        return lambda folder: change(folder, match)

    ways = [mend if isinstance(mend, Members) else partial(in_folder, mend) for mend in row.mends]
    check_remedy(use, in_order(), row.advice, ways)


#: options that are refused, the advice, and the options that follow it
OPTIONS = {
    'base': ({'base': 'chest'}, "unknown link 'chest'; links: (.*)$",
             [lambda match: {'base': listed(match)[2]}]),
    'end': ({'end': 'thumb'}, "unknown link or point 'thumb'; links: (.*); points: .*$",
            [lambda match: {'end': listed(match)[2]}]),
    'end at a point': ({'end': 'thumb'}, "unknown link or point 'thumb'; .*; points: (.*)$",
                       [lambda match: {'end': listed(match)[3]}]),
    'end above the base': ({'base': 'lower', 'end': 'upper'}, 'choose another end or base',
                           [{'base': 'upper', 'end': 'finger'}, {'base': 'base', 'end': 'upper'}]),
    'joints': ({'joints': ['knee']}, "unknown joint 'knee'; joints: (.*)$",
               [Members(lambda joint: {'joints': [joint]})]),
    'coupled joint': ({'joints': ['curl']}, "coupled joint 'curl'; joints: (.*)$",
                      [Members(lambda joint: {'joints': [joint]})]),
    'muscles': ({'muscles': ['psoas']}, "unknown muscle 'psoas'; muscles: (.*)$",
                [Members(lambda muscle: {'muscles': [muscle]})]),
    'without': ({'without': ['psoas']}, "unknown muscle 'psoas'; muscles: (.*)$",
                [Members(lambda muscle: {'without': [muscle]})]),
    'no joint': ({'base': 'upper', 'end': 'upper'},
                 'keep at least one by --joints, --base and --end',
                 [{'base': 'base', 'end': 'upper'}, {'base': 'upper', 'end': 'lower'}]),
}  # fmt: skip


@pytest.mark.parametrize('name', OPTIONS)
def test_options_of_an_import_are_accepted_after_their_advice(name, tmp_path):
    folder = files(tmp_path / 'files')
    check_remedy(lambda options: cut(read_source(folder / 'own.xml'), **options), *OPTIONS[name])


def test_an_import_is_written_to_a_directory_as_the_refusal_says(tmp_path):
    folder = files(tmp_path / 'files')
    (tmp_path / 'empty').mkdir()
    check_remedy(
        lambda out: import_robot(folder / 'cardsflow.xml', out),
        folder,
        'expected a new or empty directory',
        [tmp_path / 'new', tmp_path / 'empty'],
    )
