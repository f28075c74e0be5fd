# SPDX-License-Identifier: Apache-2.0
"""The follower: computes muscle lengths along a trajectory, and holds its end.

At each message, for the desired θ, θ̇, θ̈ (`trajectory`) and with the network's prediction ① of the
muscle lengths,

    τ = M(θ) θ̈ + h(θ, θ̇)                                       rigid bodies (pinocchio's RNEA)
    δ = k_p e + c,   e = θ − θ_estimated,   dc/dt = k_i e,   |c|, |δ| ≤ CORRECTION       `feedback`
    T = argmin ‖T‖²   subject to  −Gᵀ T + f = τ + k δ,  T_low ≤ T ≤ T_limit,   bone-side tension
    l = ①(θ + δ, T)
    l_target = l + l_comp(T e^{μ s}) + λ dl/dt

Tendon friction: the motor-side tension is T e^{μ s}. Here s is the direction in which the tendon
slides, and μ is learned or a typical value (`holdable_paths.tendon_friction`).

Joint stops: f is the torque of the stops of those joints whose desired angle is at a limit
(`robot/joint_stops.py`). Paths of an arm with isolated muscles may lead along a stop
(`holdable_paths.py`).

Lag of the muscle modules: a motor under muscle stiffness control (MSC) turns at
dl/dt = (T − T_MSC)/(K_stiff λ). Therefore the command has to lead by λ dl/dt. A tendon that is
drawn out at dl/dt resists with T_bias + K_stiff λ dl/dt, even if MSC demands only T_bias. This
tension is T_low. λ is measured while the arm moves (`winches`).

Position-controlled modules turn without tension and only lag by λ. For them, l_comp and
K_stiff λ dl/dt are 0.

A trajectory that is too fast for the muscle modules is slowed before it starts (`slowness`). The
follower also holds the end of the trajectory. The rest feedback (`feedback.Feedback`) then
continues from δ, and the plan changes only with it.

Where no tension is known, T is `Actuation.assumed_tension` in every posture, as in the samples from
which the network was learned (doc/explanation/method.md).

Method `stiffness` minimises ‖T − T_K‖² instead, where `methods.stiffness_command` computes T_K for
a setpoint that is AHEAD seconds ahead. This method uses no feedback, because feedback would change
the chosen stiffness.
"""

from __future__ import annotations

import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.control.settings import Setup
from musculoskeletal_ae.motion.activities import LENGTH, ActivityControl, Command, Inputs
from musculoskeletal_ae.motion.feedback import Feedback, Shift
from musculoskeletal_ae.motion.progress import Progress
from musculoskeletal_ae.motion.ramps import Ramp
from musculoskeletal_ae.motion.tension_plan import TensionPlan
from musculoskeletal_ae.motion.trajectory import Trajectory
from musculoskeletal_ae.motion.winches import Winches

#: gain of the rest feedback, which reduces posture error and needless tension at rest [1/s]
FEEDBACK_GAIN = 0.5
#: blend the previous command into a new plan over this time [s], so that the command does not jump
BLENDING = 0.3
#: after a trajectory, continue the feedback of the motion for this time before the arm counts as
#: resting [s]
SETTLING = 0.8
#: a muscle counts as held back by the limiter, and the feedback stops integrating, if the published
#: length exceeds the desired length by more than this [m]
HELD_BACK = 1e-4


class Follower(ActivityControl):
    """Follows trajectories, and holds the end of the last trajectory.

    Attributes:
        progress: Time, setpoint and error along the trajectories.
        plan: The planned tensions.
        winches: Measures the lag λ of the muscle modules.
        feedback: Corrects the posture.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.progress, self.plan = Progress(setup), TensionPlan(setup)
        self.winches, self.feedback = Winches(setup), Feedback(setup)
        #: l_target at rest without the relief r [m], (M,); None while the arm moves or settles
        self._held: Array | None = None
        #: ramp that reduces the difference between the last command and the present plan to 0
        self._blend: Ramp | None = None
        self._desired: Array | None = None  # the last desired command [m], (M,)

    # -- requests -------------------------------------------------------------------------------

    def follow(self, trajectory: Trajectory, delay: float = 0.0) -> None:
        """Follow a trajectory that starts `delay` [s] from now and replaces the present one."""
        if delay > 0.0:
            self.progress.next = trajectory, delay
        else:
            self.progress.begin(trajectory)
            self._leave_rest()

    def plan_anew(self) -> None:
        """Plan again, with a smooth transition from the last command to the new plan.

        If the arm was at rest, the feedback of the motion is active again until the arm has
        settled.
        """
        if self._held is not None and self.progress.trajectory is not None:
            self.progress.return_to_end()
            self.feedback.relief = np.zeros(self._setup.robot.muscle_count)
        self._held = self._blend = None

    def _leave_rest(self) -> None:
        # In motion, the trajectories join without a new plan, unless the arm has fallen.
        if self._held is not None or self.progress.has_fallen:
            self.plan_anew()

    @property
    def has_arrived(self) -> bool:
        """Whether the last trajectory has ended. If so, the arm should rest at its end."""
        return not self.progress.is_moving

    @property
    def missing_torque(self) -> Array | None:
        """Torque [N·m], (D,), by which the tensions, which are limited, fall short of the plan.

        None without a trajectory.
        """
        return None if self.progress.trajectory is None else self.plan.missing_torque

    # -- the activity ---------------------------------------------------------------------------

    def enter(self, _: Inputs) -> None:
        """Enter the activity, or continue it after a pause, from the present tensions."""
        self._held = self._blend = self._desired = None
        self.progress.return_to_end()  # plan the tensions of the held posture again
        self.plan.reset()
        self.feedback.reset()
        self.winches.forget()

    def leave(self) -> None:
        """Leave the activity, and discard the trajectories."""
        self.progress.discard()

    def step(self, inputs: Inputs) -> Command | None:
        """Advance by one control step; return the next command, or None without a trajectory."""
        progress, sent, dt = self.progress, inputs.length, inputs.dt
        if progress.trajectory is None:
            return None
        if progress.is_moving:
            sample = inputs.sample
            self.winches.step(sample.length, inputs.motor_tension, sent, dt, sample.delay)
        else:  # at rest, the measurements contain only noise and do not determine λ
            self.winches.forget()
        if progress.advance(dt):
            self._leave_rest()
        if self.plan.adopt(inputs.limit, inputs.effort):
            self.plan_anew()
        if self._held is None:
            progress.update_desired()
        progress.compare(inputs.theta)
        if progress.time < progress.trajectory.duration + SETTLING:
            length = self._moving(progress.trajectory, inputs)
        else:
            length = self._resting(inputs)
        length = np.where(self._setup.robot.used, length, sent)
        if self._blend is None:
            rate_limit = float(
                self._setup.robot.actuation.fastest(self._setup.settings.rate_limit).min()
            )
            self._blend = Ramp(sent - length, np.zeros_like(length), BLENDING, rate_limit)
        self._desired = length + self._blend.step(dt)
        return Command(LENGTH, self._desired.copy())

    def _moving(self, trajectory: Trajectory, inputs: Inputs) -> Array:
        """Return the length command [m], (M,), during the motion and while the arm settles."""
        error = self.progress.error
        error = np.zeros_like(error) if self.plan.is_stiff else error
        shift = self.feedback.in_motion(error, self._is_held_back(inputs), inputs.dt)
        return self._plan(trajectory, shift, self.winches.lag, inputs)

    def _plan(self, trajectory: Trajectory, shift: Shift, lag: float, inputs: Inputs) -> Array:
        return self.plan.step(
            trajectory,
            self.progress.time,
            shift,
            lag=lag,
            mae=inputs.mae,
            limit=inputs.limit,
            dt=inputs.dt,
        )

    def _is_held_back(self, inputs: Inputs) -> bool:
        """Return whether the limiter did not let a muscle wind in as far as desired.

        The result makes the feedback stop integrating. With isolated muscles, the result is
        always False: some of the remaining muscles are then often at their limit, but without the
        integration, the arm would sag.
        """
        if self._desired is None or not self._setup.robot.used.all():
            return False
        return bool((inputs.length - self._desired > HELD_BACK).any())

    def _resting(self, inputs: Inputs) -> Array:
        """Return the length command [m], (M,), while the arm rests at the end of its trajectory."""
        feedback, plan, trajectory = self.feedback, self.plan, self.progress.trajectory
        assert trajectory is not None
        if is_new := self._held is None:
            feedback.come_to_rest()
        before, gain = feedback.shift, 0.0 if plan.is_stiff else FEEDBACK_GAIN
        feedback.at_rest(self.progress.error, plan.jacobian, inputs, gain)
        if is_new or not np.array_equal(before, feedback.shift):
            self._held = self._plan(trajectory, feedback.shift, 0.0, inputs)
        assert self._held is not None
        return self._held + feedback.relief
