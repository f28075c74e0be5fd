# SPDX-License-Identifier: Apache-2.0
"""Every executor runs a node, asynchronous callbacks work, and unsuitable versions are rejected."""

import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.nodes.bringup_status import BringupStatusNode
from musculoskeletal_ae.ros import executor


@pytest.fixture
def version(monkeypatch):
    """Return a function that fakes the version of rclpy."""
    monkeypatch.delenv(executor.VARIABLE, raising=False)
    return lambda *numbers: monkeypatch.setattr(executor, '_rclpy_version', lambda: numbers)


# Executor `lean` is the default, so nearly all other tests of nodes use it.
@pytest.mark.parametrize('choice', ['single', pytest.param('lean', marks=pytest.mark.thorough)])
def test_under_every_executor_a_node_counts_exceptions_goes_on_and_ends_with_status_0(
    graph, monkeypatch, choice
):
    monkeypatch.setenv(executor.VARIABLE, choice)
    graph.listen(DiagnosticArray, '/diagnostics')
    process = graph.start('estimator', robot='arm26')
    graph.wait(lambda: graph.report('estimator').values, 'the report of the estimator')
    # Callbacks of muscle messages take the message and its information.
    muscles = graph.publisher(Float64MultiArray, 'muscle_states')

    def rejected():
        muscles.publish(Float64MultiArray())
        return [key for key in graph.report('estimator').values if 'muscle_states: ' in key]

    assert 'TypeError' not in graph.wait(rejected, 'a rejection')[0]
    # For this unknown parameter type, rclpy's own callback raises ValueError.
    request = SetParameters.Request(
        parameters=[Parameter(name='explore', value=ParameterValue(type=99))]
    )
    graph.call(SetParameters, 'estimator/set_parameters', request)
    graph.wait(
        lambda: any('ValueError' in key for key in graph.report('estimator').values),
        'the count of the exception',
    )
    status, output = graph.ended(process, signal.SIGTERM)
    assert status == 0, output


def test_an_exception_of_a_node_s_callback_is_counted_by_topic(graph):
    node = graph.host(BringupStatusNode, robot='arm26')

    def fails(message):
        raise ValueError(message.data)

    async def fails_later(message):
        raise KeyError(message.data)

    for topic, callback in (('sync', fails), ('async', fails_later)):
        node.create_subscription(String, topic, callback, 10)
        graph.publisher(String, topic).publish(String(data='a'))
    graph.wait(lambda: sum(node.rejected.values()) == 2, 'the counts of both exceptions')
    place = graph.namespace
    assert node.rejected == {f'{place}/sync: ValueError': 1, f'{place}/async: KeyError': 1}


def test_a_callback_that_awaits_a_future_goes_on_when_it_is_done(graph):
    answers = []
    graph.node.create_service(Trigger, 'ask', lambda _, response: response)
    client = graph.node.create_client(Trigger, 'ask')
    graph.wait(client.service_is_ready, 'the service')

    async def ask(_):
        answers.append(await client.call_async(Trigger.Request()))

    graph.node.create_subscription(String, 'begin', ask, 10)
    graph.publisher(String, 'begin').publish(String())
    graph.wait(lambda: answers, 'the answer')
    assert isinstance(answers[0], Trigger.Response)


def test_messages_are_handled_while_a_callback_awaits(graph):
    heard, future = [], Future()

    async def waits(_):
        heard.append(await future)

    graph.node.create_subscription(String, 'slow', waits, 10)
    graph.node.create_subscription(String, 'quick', lambda m: heard.append(m.data), 10)
    graph.publisher(String, 'slow').publish(String())
    quick = graph.publisher(String, 'quick')
    quick.publish(String(data='meanwhile'))
    graph.wait(lambda: heard, 'the message')
    future.set_result('done')
    quick.publish(String(data='again'))
    graph.wait(lambda: 'done' in heard, 'the end of the asynchronous callback')
    assert heard[0] == 'meanwhile'


def test_a_busy_executor_keeps_its_wait_set_and_notices_new_entities_at_once(graph, monkeypatch):
    built, ticks, heard = [], [], []
    names = executor.rclpy_implementation

    class Counting:
        def __getattr__(self, name):
            return getattr(names, name)

        @staticmethod
        def WaitSet(*counts):
            built.append(1)
            return names.WaitSet(*counts)

    monkeypatch.setattr(executor, 'rclpy_implementation', Counting())
    graph.node.create_timer(1e-3, lambda: ticks.append(1))  # something is always ready
    begun = time.monotonic()
    graph.wait(lambda: len(ticks) > 500, 'the timer')
    rounds = (time.monotonic() - begun) / executor.FULL_ROUND_PERIOD
    assert len(built) <= rounds + 2
    graph.node.create_subscription(String, 'late', heard.append, 10)
    graph.publisher(String, 'late').publish(String())
    graph.wait(lambda: heard, 'the message')


@pytest.mark.parametrize('numbers', [(7, 1, 0), (7, 2, 0), (9, 0, 0), ()])
def test_an_untested_rclpy_gets_one_of_its_own_executors(context, version, numbers):
    version(*numbers)
    chosen = executor.make_executor(context)
    assert type(chosen) is SingleThreadedExecutor
    chosen.shutdown()


@pytest.mark.parametrize('numbers', [(7, 1, 1), (7, 1, 6), (7, 1, 11)])
def test_a_tested_rclpy_gets_ours(context, version, numbers):
    version(*numbers)
    chosen = executor.make_executor(context)
    assert isinstance(chosen, executor.LeanExecutor)
    chosen.shutdown()


def test_spin_runs_lean_rounds_with_every_rclpy(context, monkeypatch):
    def raise_error(_self, _timeout_sec=None):
        raise ValueError('lean round')

    monkeypatch.setattr(executor.LeanExecutor, 'spin_once', raise_error)
    lean = executor.LeanExecutor(context=context)
    with pytest.raises(ValueError, match='lean round'):
        lean.spin()
    lean.shutdown()


def test_an_rclpy_without_a_name_that_ours_needs_gets_its_own(context, version, monkeypatch):
    version(7, 1, 6)
    monkeypatch.setattr(executor, 'PRIVATE_NAMES', ('_take_nothing',))
    chosen = executor.make_executor(context)
    assert type(chosen) is SingleThreadedExecutor
    chosen.shutdown()


@pytest.fixture
def context(graph):
    return graph.context


def test_the_choice_is_named_in_the_error(context, monkeypatch):
    monkeypatch.setenv(executor.VARIABLE, 'fast')
    named = f"{executor.VARIABLE}='fast'.*legal: lean, single"
    with pytest.raises(MusculoskeletalError, match=named):
        executor.make_executor(context)
