# SPDX-License-Identifier: Apache-2.0
"""Install the package, its robots and its executables (see setup.cfg for where the latter go).

setup.cfg also states what the package needs of pip, in ranges.
"""

from collections import defaultdict
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'musculoskeletal_ae'
NODES = ['bringup_status', 'controller', 'estimator', 'hardware_emulator', 'learner', 'sim']
COMBINED = ['combined']
ROS_TOOLS = ['check_driver', 'record', 'render', 'replay', 'view']
TOOLS = [
    'check_robot', 'experiment', 'export_mjcf', 'fit_series_elastic', 'import_robot', 'train'
]  # fmt: skip

#: what only the page and only the experiments need: extras of `pip install .[view,experiments]`
EXTRAS = {
    'view': ['viser', 'websockets', 'trimesh', 'Jinja2'],
    'experiments': ['matplotlib', 'mujoco', 'Jinja2', 'cma', 'joblib'],
}
BUILD = ['colcon-common-extensions', 'setuptools']  # with which the scripts build a ROS package


def requirements() -> dict[str, list[str]]:
    """Return what requirements.txt pins, as compatible releases: of the core ('') and of extras."""
    found = defaultdict(list)
    # colcon runs this file by a link in its build folder.
    text = Path(__file__).resolve().with_name('requirements.txt').read_text('utf-8')
    for line in filter(None, (line.partition('#')[0].strip() for line in text.splitlines())):
        name = line.partition('==')[0]
        if name not in BUILD:
            for extra in [extra for extra, names in EXTRAS.items() if name in names] or ['']:
                found[extra].append(line.replace('==', '~=', 1))
    return found


def config_files() -> list[tuple[str, list[str]]]:
    """List config/** folder by folder, so that robots keep their directories under share/."""
    folders = defaultdict(list)
    for file in sorted(Path('config').rglob('*')):
        if file.is_file():
            folders[f'share/{NAME}/{file.parent.as_posix()}'].append(file.as_posix())
    return list(folders.items())


def bag_files() -> list[tuple[str, list[str]]]:
    """List the shipped recordings, each a directory of its own under share/."""
    folders = sorted({file.parent for file in Path('bags').glob('*/metadata.yaml')})
    listed = [(folder.as_posix(), sorted(folder.iterdir())) for folder in folders]
    listed.append(('bags', [Path('bags/README.md')]))
    return [(f'share/{NAME}/{to}', [file.as_posix() for file in files]) for to, files in listed]


NEEDED = requirements()
setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(exclude=['bench', 'bench.*', 'test', 'test.*']),
    package_data={NAME: ['*.yaml', '*/*.yaml', '*/*.jinja']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        # `ros2 run musculoskeletal_ae bringup.sh`; the other files belong to it.
        (f'lib/{NAME}', ['bringup.sh']),
        (f'share/{NAME}/.ci', ['.ci/environment.sh', '.ci/udp.sh', '.ci/compile.py']),
        *bag_files(),
        *config_files(),
    ],
    install_requires=NEEDED.pop(''),
    # colcon test looks in "test" for the kind of tests there are.
    extras_require={**NEEDED, 'test': ['pytest']},
    zip_safe=False,
    maintainer='musculoskeletal_ae maintainers',
    maintainer_email='maintainers@musculoskeletal-ae.org',
    description='Musculoskeletal autoencoder for tendon-driven robot arms',
    license='Apache-2.0',
    python_requires='>=3.10',
    entry_points={
        'console_scripts': [
            f'{name} = {NAME}.executables:{name}' for name in NODES + COMBINED + ROS_TOOLS + TOOLS
        ],
    },
)
