# SPDX-License-Identifier: Apache-2.0
"""`experiment`: its output for any robot, and its errors."""

import importlib
import json
import math
import pkgutil
import shutil
from html.parser import HTMLParser

import pytest

from musculoskeletal_ae import experiments
from musculoskeletal_ae.experiments.results import write_report
from musculoskeletal_ae.experiments.runner import EXPERIMENTS
from musculoskeletal_ae.tools import experiment

# Keys that result.json must contain, for each experiment.
KEYS = {
    'online_learning': 'before_rad after_rad paper_before_rad paper_after_rad oracle_rad '
    'fit_start_rad fit_end_rad samples samples_to_halve paper_samples_to_halve',
    'estimation': 'before_rad before_payload_rad after_rad after_payload_rad '
    'a_before_healthy_max a_before_ruptured_min a_healthy_max a_ruptured_min threshold '
    'paper_after_payload_rad paper_a_switched_off_second '
    'detection_s false_alarms auroc named_share',
    'control': 'qp_bound_n',
    'simulation': 'before_rad after_rad before_n after_n frictionless_rad',
    'loss_change': '',
    'body_change': 'angle_change_mm paper_angle_change_mm nonlinearity_true',
    'layers': 'layers trainings',
    'motion': 'track_1s_rad track_2s_rad settled_rad tension_ratio hand_circle_m '
    'wrench_error false_contacts settle_s distance_rad approaches missed stuck',
    'resilience': 'healthy_rad one_isolated_rad two_isolated_rad proposed_one_isolated_rad '
    'right_isolations_share wrong_isolations dead_sensor_rad',
    'robustness': 'kin foreign ablation_rad',
    'sensors': 'all_rad elbow_only_rad none_rad marker_tenth_rad imu_rad before_rad '
    'ellipsoid_share',
}
REALITY = 'before_rad after_rad paper_after_rad oracle_rad informed_oracle_rad samples_to_halve'
METHODS = ('geometric', 'first', 'second', 'proposed', 'second_paper', 'proposed_paper')


def result(folder, name):
    return json.loads((folder / name / 'result.json').read_text(encoding='utf-8'))


def numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for part in value for number in numbers(part)]
    return [value] if isinstance(value, float) else []


class Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.targets = []
        self.open = []

    def handle_starttag(self, tag, attrs):
        assert tag not in ('script', 'iframe', 'object')
        self.targets += [value for key, value in attrs if key in ('src', 'href', 'srcset')]
        if tag not in ('meta', 'link', 'img', 'br'):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_every_module_with_an_experiment_is_registered():
    modules = pkgutil.iter_modules(experiments.__path__, f'{experiments.__name__}.')
    loaded = [importlib.import_module(module.name) for module in modules]
    defined = [module.EXPERIMENT for module in loaded if hasattr(module, 'EXPERIMENT')]
    assert len(defined) == len(EXPERIMENTS)
    assert all(experiment in defined for experiment in EXPERIMENTS.values())


@pytest.mark.parametrize('name', EXPERIMENTS)
def test_every_experiment_writes_its_keys_with_finite_numbers(quick, name):
    content = result(quick, name)
    assert set(KEYS[name].split()) <= set(content)
    assert set(KEYS[name].split()) <= set(content['seeds']['0'])
    assert all(math.isfinite(number) for number in numbers(content))


def test_control_has_every_method_of_the_paper(quick):
    content = result(quick, 'control')
    for method in METHODS:
        assert {'error_rad', 'error_var', 'tension_n'} <= set(content[method])


def test_robustness_has_both_emulator_models_and_says_why_a_number_is_missing(quick):
    content = result(quick, 'robustness')
    for reality in ('kin', 'foreign'):
        assert set(REALITY.split()) <= set(content[reality])
    # The informed oracle also knows the true sensor errors and tendon friction, so its error must
    # be the smallest.
    kin = content['kin']
    assert kin['informed_oracle_rad'] < min(kin['oracle_rad'], kin['least_squares_rad'])
    assert content['kin']['after_rad'] == result(quick, 'online_learning')['after_rad']
    assert content['foreign']['after_rad'] != content['kin']['after_rad']


@pytest.mark.parametrize('name', EXPERIMENTS)
def test_every_experiment_draws_the_plots_it_lists(quick, name):
    plots = result(quick, name)['plots']
    assert plots
    for plot in plots:
        assert (quick / name / plot['file']).read_bytes().startswith(b'\x89PNG')
        assert plot['caption']


def test_the_report_is_one_well_formed_page_without_external_files(quick):
    page = (quick / 'report.html').read_text(encoding='utf-8')
    links = Links()
    links.feed(page)
    assert not links.open
    plots = sum(len(result(quick, name)['plots']) for name in EXPERIMENTS)
    assert sum(link.startswith('data:image/png;base64,') for link in links.targets) == plots
    assert all(link.startswith(('data:', '#')) for link in links.targets)
    assert 'url(' not in page


def test_the_report_has_the_papers_numbers_and_the_command_to_repeat_it(quick):
    page = (quick / 'report.html').read_text(encoding='utf-8')
    for printed in ('0.414', '0.186', '0.324', '0.154', '0.335', '0.162', '105', '92.2'):
        assert f'<td>{printed}</td>' in page
    assert 'experiment all --robot arm26 --preset default --seeds 0 --minutes 0.2 --quick' in page


def test_the_report_names_missed_aims_and_their_difference(quick, tmp_path):
    folder = tmp_path / 'bad'
    shutil.copytree(quick, folder)
    content = result(folder, 'control')
    content['proposed']['error_rad'] = 0.5
    (folder / 'control' / 'result.json').write_text(json.dumps(content), encoding='utf-8')
    page = write_report(folder).read_text(encoding='utf-8')
    assert '<span class="missed">missed by 0.440</span>' in page
    assert 'proposed, distance from θ_eval [rad]' in page.split('Goals missed:')[1].split('</p>')[0]


def test_the_report_of_one_experiment_contains_only_that_one(quick, tmp_path):
    shutil.copytree(quick / 'body_change', tmp_path / 'body_change')
    page = write_report(tmp_path).read_text(encoding='utf-8')
    assert page.count('<h2 id=') == 1
    assert (
        'experiment body_change --robot arm26' in page and 'Comparison with the paper' not in page
    )


@pytest.mark.parametrize(
    'wrong',
    [
        ['nothing'],
        ['all', '--seeds', '1,1'],
        ['all', '--minutes', '0'],
    ],
)
def test_bad_options_end_with_status_2(wrong, capsys):
    with pytest.raises(SystemExit) as ended:
        experiment.main(wrong)
    assert ended.value.code == 2
    assert 'error' in capsys.readouterr().err


def test_a_missing_robot_ends_with_status_1(tmp_path, capsys):
    folder = tmp_path / 'out'
    assert experiment.main(['all', '--robot', str(tmp_path / 'none'), '--out', str(folder)]) == 1
    assert 'none' in capsys.readouterr().err
    assert not folder.exists()


def test_a_folder_that_cannot_be_made_ends_with_status_1(tmp_path, capsys):
    file = tmp_path / 'file'
    file.write_text('in the way')
    assert experiment.main(['all', '--robot', 'arm26', '--out', str(file)]) == 1
    assert str(file) in capsys.readouterr().err
