# SPDX-License-Identifier: Apache-2.0
"""The advice of each kind of condition is followed somewhere, and this table says where.

A place is a test, a mishap of `bench mishaps`, whose operator takes the advised steps literally,
or a kind of attack of `bench attack`. Kinds whose advice is followed nowhere else are at the end of
this file. A kind without advice needs no place: the condition ends by itself.
"""

import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from estimation.test_body_memory import FOUND, MUSCLES

from bench.attack_kinds import KINDS as ATTACKS
from bench.mishap_kinds import NAMES as MISHAPS
from musculoskeletal_ae import remembered_text
from musculoskeletal_ae.conditions import ConditionKind as Kind
from musculoskeletal_ae.control.stop_memory import StopMemory
from musculoskeletal_ae.emulator.reality import make_arm
from musculoskeletal_ae.estimation.body_memory import BodyMemory
from musculoskeletal_ae.remedy_steps import Step
from musculoskeletal_ae.robot.robot import Robot
from musculoskeletal_ae.ros.needed_topics import SLOW_REPORTS, NeededTopics

TESTS = Path(__file__).parent
HERE = Path(__file__).name
JOINTS = 'estimation/test_joint_sensor_trust.py'
PLACES = {
    Kind.NODE_ENDED: ['nodes/test_controller_stops.py: test_a_crashed_estimator_stops',
                      'nodes/test_bringup_status.py: test_nodes_that_have_ended_or_hang'],
    Kind.NODE_SILENT: ['attack: silent node',
                       'nodes/test_bringup_status.py: test_nodes_that_have_ended_or_hang'],
    Kind.SECOND_PUBLISHER: ['attack: second node',
                            'nodes/test_trust.py: test_a_second_publisher_of_muscle_states_stops'],
    Kind.SILENT_TOPIC: ['nodes/test_controller_stops.py: test_a_lost_driver_stops_the_arm',
                        'mishap: messages pause for 5 s'],
    Kind.SLOW_TOPIC: [f'{HERE}: test_a_topic_that_is_fast_enough_again'],
    Kind.EMULATION_DIVERGED: ['nodes/test_hardware_emulator.py: test_an_impossible_wrench'],
    Kind.MODULES_IN_SAFE_STATE: [f'{HERE}: test_modules_leave_their_safe_state'],
    Kind.EMULATED_FAULT: ['nodes/test_hardware_emulator.py: test_a_muscle_is_ruptured_and'],
    Kind.SLACK_TENDON: ['mishap: tendon ruptures under load'],
    Kind.MODULE_NOT_FOLLOWING: ['mishap: module jams'],
    Kind.SENSOR_FROZEN: ['mishap: length reading freezes'],
    Kind.RESIDUAL_DISTANCE: ['mishap: tension reading has an offset'],
    Kind.LENGTH_JUMP: ['mishap: spool slips on its shaft'],
    Kind.LENGTHS_JUMPED: ['mishap: driver restarts, lengths counted from 0'],
    Kind.MUSCLES_EXCHANGED: ['mishap: driver restarts, two muscles exchanged'],
    Kind.LENGTH_DISAGREES: ['mishap: tendon creeps'],
    Kind.LENGTHS_DISAGREE: ['mishap: driver restarts, lengths counted from 0'],
    Kind.JOINT_SENSORS_DOUBTED: [
        f'{JOINTS}: test_a_sensor_that_slips_is_doubted_until_it_agrees',
        f'{JOINTS}: test_a_sensor_that_the_user_confirms_is_trusted'],
    Kind.JOINT_READINGS_IMPOSSIBLE: [
        'estimation/test_lost_lengths.py: test_joint_sensors_are_not_used_while_a_second_program'],
    Kind.JOINT_READINGS_MISSING: [
        'estimation/test_lost_lengths.py: test_a_joint_sensor_that_is_unplugged_is_named_until',
        'estimation/test_lost_lengths.py: test_a_joint_sensor_that_was_removed_is_not_expected'],
    Kind.READINGS_REJECTED: ['mishap: driver restarts in mm'],
    Kind.VALUES_MISSING: ['mishap: length reads NaN'],
    Kind.SENSOR_SATURATED: ['mishap: tension readings saturate'],
    Kind.HOT_MODULE_CHANGED: ['mishap: motor is hot',
                              'signals/test_heat.py: test_a_changed_module'],
    Kind.MODULE_CHANGED: ['signals/test_heat.py: test_a_changed_module'],
    Kind.MUSCLE_ISOLATED: ['nodes/test_isolation.py: test_a_ruptured_muscle_is_verified_isolated'],
    Kind.MUSCLE_NEEDED: ['nodes/test_isolation.py: test_a_ruptured_muscle_is_verified_isolated'],
    Kind.LENGTH_OFFSETS_UNKNOWN: ['nodes/test_zeroing.py: test_length_offsets_are_found_and_reach'],
    Kind.LENGTH_CALIBRATION_STUCK: [
        # calibrating again is a new calibration of the corrected readings
        'estimation/test_length_calibration.py: test_a_wrong_order_or_sign_is_named',
        'estimation/test_length_calibration.py: test_length_offsets_are_found_with_joint_sensors'],
    Kind.OTHER_MOUNTING: ['mishap: mounted upside down',
                          'estimation/test_mounting.py: test_a_base_that_is_turned_while'],
    Kind.UNSUITABLE_NETWORK: ['mishap: network of another individual'],
    Kind.OPERATOR: ['nodes/test_controller_stops.py: test_a_stop_pays_out_is_reported'],
    Kind.RESTARTED: ['nodes/test_controller_stops.py: test_after_a_killed_controller_or_a_stop'],
    Kind.CONTROL_FAULT: ['control/test_controller.py: test_an_exception_in_the_controller_stops'],
    Kind.COMMAND_NOT_FINITE: ['control/test_controller.py: test_a_network_that_answers_nan_stops'],
    Kind.UNFIT_CHECKPOINT: [f'{HERE}: test_a_reset_ends_a_stop_after_its_cause'],
    Kind.NO_CHECKPOINT: ['nodes/test_sim.py: test_the_simulator_waits_for_a_checkpoint'],
    Kind.ANOMALY: ['nodes/test_controller_stops.py: test_an_anomaly_stops_the_arm_until'],
    Kind.LENGTH_OFFSETS_REVOKED: [
        'control/test_faults.py: test_the_services_of_a_length_calibration_may_follow'],
    Kind.IMPLAUSIBLE_MUSCLE_STATES: [
        'control/test_trust.py: test_implausible_data_that_last_stop_the_arm'],
    Kind.IMPLAUSIBLE_ESTIMATE: ['mishap: network of another individual'],
    Kind.OVERLOAD: ['control/test_trust.py: test_a_tension_that_stays_above_its_limit'],
    Kind.OVERHEATED: ['control/test_trust.py: test_a_stop_by_overheating_can_be_reset_once'],
    Kind.STALE_MUSCLE_STATES: ['nodes/test_controller_stops.py: test_a_lost_driver_stops_the_arm'],
    Kind.STALE_ESTIMATE: ['nodes/test_controller_stops.py: test_a_crashed_estimator_stops'],
    Kind.GENTLE_ONLY: ['nodes/test_zeroing.py: test_length_offsets_are_found_and_reach'],
    Kind.NOT_EXPLORING: ['control/test_controller.py: test_an_arm_that_no_longer_explores_says_so'],
    Kind.TARGET_CLAMPED: ['control/test_target.py: test_another_target_ends_what_is_wrong'],
    Kind.TORQUE_MISSING: ['control/test_target.py: test_another_target_ends_what_is_wrong'],
    Kind.OUT_OF_REACH: ['control/test_target.py: test_another_target_ends_what_is_wrong'],
    Kind.LOAD_CHANGED: ['mishap: mounted upside down',
                        'control/test_resting_load.py: test_a_base_turned_under_a_resting_arm',
                        'control/test_resting_load.py: test_a_push_on_the_hand_is_another'],
    Kind.AWAY_FROM_TARGET: ['mishap: payload of 3.6 kg while holding',
                            'control/test_holding.py: test_an_arm_away_from_its_target'],
    Kind.TENSION_LIMITED_BY_HEAT: ['mishap: motor is hot'],
    Kind.TRAINING_FAILED: [
        'nodes/test_learner.py: test_a_killed_learner_resumes_from_its_saved_state'],
    Kind.STATE_NOT_SAVED: ['learning/test_remedies.py: test_the_state_is_saved_after_space',
                           f'{HERE}: test_offsets_are_saved_once_the_directory_can_be_written',
                           f'{HERE}: test_a_stop_is_saved_once_the_directory_can_be_written'],
    Kind.SENSOR_OFFSET_IMPOSSIBLE: [
        'nodes/test_learner.py: test_a_checkpoint_set_at_run_time_replaces_the_saved_state',
        'learning/test_sensor_offsets.py: test_an_update_with_an_impossible_sensor_offset'],
    Kind.LEARNING_DISABLED: [
        'nodes/test_learner.py: test_an_anomaly_and_learner_enable_stop_learning'],
}  # fmt: skip
#: kinds with an advice that no situation can show to help
EXCEPTIONS = {
    Kind.INTERNAL_ERROR: 'the advice is to report an error of this package; it changes no state',
}


@cache
def names_in(file):
    return re.findall(r'^def (test_\w+)', (TESTS / file).read_text(), re.MULTILINE)


def exists(place, kind):
    """Return whether a place of the table exists, and states a condition of this kind."""
    where, _, name = place.partition(': ')
    if where == 'attack':
        return name in ATTACKS
    if where == 'mishap':
        mishap = MISHAPS[name]
        states = kind.identifier in mishap.true | mishap.allowed
        return states or bool(re.search(mishap.says or '$^', kind.text))
    return any(test.startswith(name) for test in names_in(where))


@pytest.mark.parametrize('kind', Kind, ids=lambda kind: kind.identifier)
def test_the_advice_of_every_kind_is_followed_somewhere(kind):
    if not kind.steps:
        assert kind not in PLACES
    elif kind in EXCEPTIONS:
        assert kind not in PLACES and EXCEPTIONS[kind]
    else:
        assert PLACES[kind]
        for place in PLACES[kind]:
            assert exists(place, kind), place


def test_every_step_is_advised_by_a_kind_or_where_a_node_states_its_own():
    advised = {step for kind in Kind for step in kind.steps}
    code = ''.join(file.read_text() for file in (TESTS.parent / 'musculoskeletal_ae').rglob('*.py'))
    for step in set(Step) - advised:
        assert f'Step.{step.name}' in code, step


# -- kinds whose advice is followed nowhere else --------------------------------------------------


def test_offsets_are_saved_once_the_directory_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(remembered_text, 'RETRY_INTERVAL', 0.0)
    directory = tmp_path / 'state'
    directory.write_text('')  # a file in place of the directory
    memory = BodyMemory(directory, MUSCLES)
    memory.note(FOUND)
    assert 'cannot be saved' in memory.problem
    directory.unlink()
    memory.note(FOUND)  # the same body state, as with the next message
    assert memory.problem == ''
    assert BodyMemory(directory, MUSCLES).found.isolated == FOUND.isolated


def test_a_stop_is_saved_once_the_directory_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(remembered_text, 'RETRY_INTERVAL', 0.0)
    arm = tmp_path / 'arm'
    memory = StopMemory(arm)
    arm.rename(tmp_path / 'moved')
    arm.write_text('')  # a file in place of the directory
    memory.note(Kind.OPERATOR.condition())
    assert 'the stop cannot be saved' in memory.problem
    arm.unlink()
    memory.note(Kind.OPERATOR.condition())
    assert memory.problem == ''
    memory.close()
    assert StopMemory(arm).found.kind is Kind.OPERATOR


def test_modules_leave_their_safe_state_when_commands_arrive():
    arm = make_arm(Robot.load('arm26'))
    arm.step(1.0)
    assert arm.safe
    arm.command_length(arm.sense().muscles.length)
    arm.step(0.01)
    assert not arm.safe


def test_a_topic_that_is_fast_enough_again_is_not_reported():
    arrival = SimpleNamespace(rate=10.0, was_used=True, age=lambda _: 0.0)
    reception = SimpleNamespace(arrivals={'muscle_states': arrival}, last_rejected='')
    topics = NeededTopics(SimpleNamespace(), str, reception)
    topics.expect_rate('muscle_states', 100.0)

    def reported():
        topics.check_rates()
        return [each.kind for each in topics.conditions()]

    for _ in range(SLOW_REPORTS):
        kinds = reported()
    assert kinds == [Kind.SLOW_TOPIC]
    arrival.rate = 100.0
    assert reported() == []


@pytest.mark.parametrize('kind', [each for each in Kind if each.stop and each.stop.is_event])
def test_a_reset_ends_a_stop_after_its_cause(kind):
    from control.test_controller import settled

    bench = settled(first_duration=0.5)
    bench.core.stop(kind)
    bench.step(100)
    assert bench.cause
    assert bench.core.reset(bench.now) is None
    bench.step(100)
    assert bench.cause == '' and np.isfinite(bench.theta).all()
