# SPDX-License-Identifier: Apache-2.0
"""Parameters for the connection of the motors of a ros2_control robot to its muscles."""

from dataclasses import dataclass

from musculoskeletal_ae.parameters import Parameter

ARRAY = 'std_msgs/msg/Float64MultiArray'
JOINT_STATE = 'sensor_msgs/msg/JointState'

_EACH = 'one value for all muscles, or one for each'


@dataclass(frozen=True)
class MotorSettings:
    """The parameters of `motor_interface`.

    Lists are in the order of muscles.yaml, except `motor_command_order`, which states the order of
    the command controller.
    """

    motor_state_topic: str = Parameter(
        '',
        'topic of the JointState messages that contain the motors of the muscles, as '
        'joint_state_broadcaster publishes them (empty: muscle_states)',
    ).field()
    motor_command_topic: str = Parameter(
        '',
        'topic of commands to the motors, to which forward_command_controller subscribes (empty: '
        'only muscle_length_command is published)',
    ).field()
    motor_names: tuple[str, ...] = Parameter(
        ('',), 'joint that is the motor of each muscle ([""]: the names of the muscles)'
    ).field()
    motor_command_order: tuple[str, ...] = Parameter(
        ('',),
        'motors in the order of the command controller\'s `joints` ([""]: order of motor_names)',
    ).field()
    spool_radius: tuple[float, ...] = Parameter(
        (1.0,),
        'length of tendon per unit of motor position: radius of the spool for angles, 1 for '
        f'lengths in m; {_EACH}',
        'm',
        (1e-4, 10.0),
    ).field()
    motor_direction: tuple[float, ...] = Parameter(
        (1.0,),
        '1 if the motor position rises as the motor pays out, -1 if it rises as the motor winds '
        f'in; {_EACH}',
        '',
        (-1.0, 1.0),
    ).field()
    motor_zero: tuple[float, ...] = Parameter(
        (0.0,), f'motor position at which l is 0; {_EACH}', '', (-1e6, 1e6)
    ).field()
    tension_per_effort: tuple[float, ...] = Parameter(
        (1.0,),
        'tension per unit of effort: 1 for tensions in N, 1/radius for torques in N·m; negative if '
        f'the effort falls as the motor pulls; {_EACH}',
        'N',
        (-1e6, 1e6),
    ).field()
    effort_zero: tuple[float, ...] = Parameter(
        (0.0,), f'effort at which T is 0; {_EACH}', '', (-1e6, 1e6)
    ).field()
