# SPDX-License-Identifier: Apache-2.0
"""What the report says of each experiment: what the paper did, and how it is measured here."""

from __future__ import annotations

from typing import NamedTuple


class Text(NamedTuple):
    """Of one experiment.

    Attributes:
        title: Heading.
        paper: What the paper did and found, on Musashi.
        here: How it is measured here.
    """

    title: str
    paper: str
    here: str


TEXTS = {
    'online_learning': Text(
        'Online learning',
        'Ten minutes of random motion in three steps (5 s first, 2 s second, 3 s random tension, '
        'T_bias 30 N, T_limit 200 N) while learning; the exponential fit of the error went from '
        '0.324 to 0.154 rad.',
        'The initial network knows the geometric model only. One stream of sensor messages of each '
        'individual, commanded by the initial default network, feeds both presets. The held-out '
        'motion follows one fixed list of commands from a random stream that is never used for '
        'learning; its error is the mean over all messages at 100 Hz, moving and resting, of '
        '‖θ_est − θ_true‖ over all joints, with the true angles of the emulator. Oracle: weighted '
        'least squares on one message with the true routes, elastic constants and noise, friction '
        'taken as zero.',
    ),
    'estimation': Text(
        'State estimation and anomaly',
        'The same motions before and after learning, 0.414 → 0.186 rad; the error did not rise '
        'much when a 3.6 kg dumbbell was grasped; when muscle #2 was deactivated, A rose after '
        'learning but hardly before.',
        'One recording, seen by both networks: the held-out motion, with 3.6 kg in the hand from '
        'its middle on; then, weight in hand, every muscle in turn is cut for 3 s and mended. A '
        'cut comes when the muscle carries more than 10 N above T_bias (waiting up to 14 s; a '
        'muscle that never does is cut all the same, shown in grey, and not counted). Messages go '
        'one by one through the detector of the estimator node; detection is the first alarm that '
        'begins after the cut, a cut not found counts 3 s. The right muscle is named if it is the '
        'suspect in that message. Healthy messages: the held-out motion and another one with '
        'the weight grasped and released every minute, an hour over all individuals; false alarms '
        'are alarms that begin in the latter. AUROC compares d of those with d of cut messages '
        'from 0.1 s after the cut. "Threshold" is the detector’s, for d; A and d "ruptured min" '
        'are the smallest, over muscles, of the median while cut.',
    ),
    'control': Text(
        'Control',
        'Five random θ_eval, each approached from five random postures, by the geometric model, '
        'by `first`, `second` and `proposed` after learning: all learnt ones far better than '
        'geometric; `proposed` as exact as `second` with less tension than either.',
        'The same, in closed loop with the estimator and the controller that the nodes run, on '
        'targets that the true body can hold within [T_bias, T_limit]; read 8 s after the '
        'command. `proposed_paper` is the printed method on the network of preset paper. '
        'QP bound: the least ‖T‖ with which the true body holds θ_eval. "Bound reached": the same '
        'at the posture where the arm came to rest. What all starts of a target have in common is '
        'the model’s error, their scatter is hysteresis.',
    ),
    'simulation': Text(
        'Simulation',
        'Arm and simulator under the same commands: 0.335 → 0.162 rad and 105 → 92.2 N by '
        'learning.',
        'The commands of the held-out motion, over all messages; the simulator starts in the '
        'arm’s first posture and sees nothing else of it. θ beside the true angles, T beside the '
        'measured tensions. The bound is the emulated individual itself without any friction: '
        'what a perfect simulator without hysteresis would be left with.',
    ),
    'loss_change': Text(
        'Simulation with another loss',
        'Elbow bent to 90°, −50 N in z and 50 N in y at the hand, then S-p forced to 30°.',
        'The same; the command holds the posture by `proposed` on the learnt network. The emulated '
        'arm is pushed alike. On robots without elbow_pitch and shoulder_pitch, joints called '
        'elbow and shoulder, or else the last and the first, play their parts.',
    ),
    'body_change': Text(
        'What learning changes in the body',
        'l against S-p from −120° to 30° at T = 0, and against T from 0 to 500 N at θ = 0: changes '
        'up to 40 mm, largest in #2, #3 and #7; tension curves from linear to strongly curved.',
        'The same, through ① of the network, beside the true body. Where θ = 0 lies outside a '
        'joint’s limits (the elbow’s, by 5°) it is kept all the same. "Shape" is the error of a '
        'curve beside the true one after their mean difference is taken off.',
    ),
}
