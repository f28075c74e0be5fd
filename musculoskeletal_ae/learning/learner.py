# SPDX-License-Identifier: Apache-2.0
"""Online learning from messages to checkpoints: what the node ships and experiments measure.

    θ, (T, l) ─ paired by time ─► rests that may be learned from ─ new ones ─► samples
                     │                                                            │
                     └─► messages of the healthy arm ─► update of the network ◄───┘
                                                                 │
                                            disk, subscribers ◄──┘

What isolated muscles read is put away at the door: a sample says nothing about them, neither the
body nor the detector learns of them, and the network that is published knows that they are.

Time is the caller's: the ROS clock, recorded or simulated time. All rules on time are rules on
that, so that a recording steps exactly what runs on a robot, but that training takes no time there.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.estimation.checkpoint_validation import CheckpointValidator
from musculoskeletal_ae.estimation.healthy_torque import HealthyTorque
from musculoskeletal_ae.exceptions import GateError, StateError
from musculoskeletal_ae.learning.calibration import Reservoir, is_calibrated, uncalibrated
from musculoskeletal_ae.learning.rest import RestCollector
from musculoskeletal_ae.learning.samples import NOTHING, Sample, SampleStore
from musculoskeletal_ae.learning.settings import DEFAULT, STEPS, Settings
from musculoskeletal_ae.learning.state import StateStore
from musculoskeletal_ae.learning.training import Job, Training, Update
from musculoskeletal_ae.mae import checkpoint
from musculoskeletal_ae.mae.mae import Mae
from musculoskeletal_ae.pairing import Pairing
from musculoskeletal_ae.report import Level, Report
from musculoskeletal_ae.robot.robot import Robot

#: between the beginnings of two updates, and between two checkpoints [s]
LEAST_INTERVAL = 1.0
#: what θ comes from: joint sensors at any joints, a camera now and then, or nothing
SENSOR, MARKER, NONE = 'sensor', 'marker', 'none'
SPREAD = 0.02  # of θ as a camera sees it [rad]; where it slides, times RACK [m]
LEAST_BLIND = 20  # samples to begin with where no θ is known


class Learner:
    """Learns the body of one arm."""

    def __init__(
        self,
        robot: Robot,
        mae: Mae | None = None,  # fits the robot; None: wait for one
        preset: str = 'default',
        seed: int = 0,
        *,
        steps: int = STEPS,  # of training per update, in preset default
        period: float = 0.01,  # of the messages of the muscle modules [s]
        settings: Settings = DEFAULT,  # what counts as rest, and as new
        joint_source: str = SENSOR,  # what θ comes from
        training: Callable[[Robot, str, int], Training] = Training,
        directory: Path | None = None,  # where samples and network are kept; None for nowhere
    ) -> None:
        """Go on from the saved state, if there is one that fits, else from a network.

        Raises:
            MusculoskeletalError: If there is no such preset.
            StateError: If the directory cannot be used.
        """
        self.robot = robot
        self.training = training(robot, preset, seed)
        radian = robot.kinematics.radian
        self.samples = SampleStore(settings, radian=radian)  # what is learned from
        self._mae: Mae | None = None
        self.checkpoint: bytes | None = None  # the network as learned so far
        self.enabled = self._zeroed = True
        self.last_update: Update | None = None
        self.updates = self.published = 0  # updates made, checkpoints given out
        self._pairing = Pairing(period)
        self._healthy = Reservoir(robot.muscle_count, seed, settings, radian=radian)
        spread = SPREAD * radian if joint_source == MARKER else NOTHING
        blind = joint_source != SENSOR
        self._rests = RestCollector(robot, settings, self._healthy, blind, spread)
        # Nothing of θ, and nothing of gravity (see `Sample`): one array, which is paired as θ is
        self._unseen = np.full(robot.joint_count + 3 * len(robot.kinematics.parent), np.nan)
        self._torque = HealthyTorque(robot)
        self.rejected = self._rests.rejected  # what was not learned from, by reason
        least = self.training.preset.least_samples
        self._least_samples = least if joint_source == SENSOR else max(least, LEAST_BLIND)
        self._steps = steps
        self._news = True  # to learn from, since the last update began
        self._begun = self._given = -math.inf  # the last update, the last checkpoint [s]
        self._to_publish = False
        # Where they do not, the network says that its detector is not calibrated.
        self._statistics_hold = True
        self._forgot = False  # a muscle, since the update began
        self.gate = CheckpointValidator(robot)
        self._spoiled = np.zeros(robot.muscle_count, dtype=bool)  # healthy messages lack these
        self._gate_time = 0.0  # [s] of the messages
        self.refused = 0  # updates that the gate did not let through
        self.last_refused = ''
        self._state = None if directory is None else StateStore(directory, robot)
        saved = self._load()
        # Samples without their network (damaged, refused, or of the robot with fewer muscles) bring
        # as many updates as when they came.
        self._updates_to_repeat = len(self.samples) if saved is None else 0
        if saved is not None:
            self._go_on_from(saved)
        elif mae is not None:
            self.begin(mae)

    # -- messages → samples ---------------------------------------------------------------------

    def step(self, time: float, theta: Array | None, tension: Array, length: Array) -> bytes | None:
        """Take what was measured at `time` [s], and `poll`; θ is None where it was not."""
        if theta is not None:
            self.joints(time, theta)
        self.muscles(time, tension, length)
        return self.poll(time)

    def joints(self, time: float, theta: Array) -> None:
        """Take a θ [rad] (D,) that came at `time` [s]."""
        self._see(time, 0, theta)

    def imu(self, time: float, link: str, acceleration: Array) -> None:
        """Take what an accelerometer in a link's axes read at `time` [m/s²] (3,).

        At rest that is what holds it against gravity, so that it tells where down is; of readings
        in motion nothing is learned.
        """
        joint, placement = self.robot.kinematics.placement(link)
        down = -placement.rotation @ acceleration / np.linalg.norm(acceleration)
        self._see(time, self.robot.joint_count + 3 * joint, down)

    def _see(self, time: float, first: int, values: Array) -> None:
        seen = self._unseen.copy()
        seen[first : first + len(values)] = values
        self._pairing.joints(time, seen)

    def muscles(self, time: float, tension: Array, length: Array) -> None:
        """Take T [N] and l [m] (M,) that came at `time` [s]."""
        paired = self._pairing.muscles(time, tension, length)
        if paired is None or not (self.enabled and self._zeroed):
            return
        _, tension, length, dt, seen = paired
        known = self._unseen if seen is None else seen
        theta, gravity = np.split(known, [self.robot.joint_count])
        if self.isolated:
            tension, length = tension * self._used, length * self._used
        self._gate_time += dt
        before = self._healthy.time
        rests = self._rests.step(tension, length, dt, theta, gravity)
        if self._rests.plausible:
            self.gate.message(tension, length, self._gate_time)
            if self._mae is not None and not self._rests.anomaly:
                self._torque.step(tension, length, dt)
        if self._healthy.time > before:
            self._spoiled |= ~self._used
        for rest in rests:
            self._healthy.rest(rest)
            if self.samples.is_new(rest):
                self.accept(rest)
            else:
                self.rejected['like a stored one'] += 1

    def accept(self, sample: Sample) -> None:
        """Keep a new sample, on disk too, and learn from it soon."""
        self.samples.add(sample, self._used.copy())
        self._keep()
        self._news = True

    def anomaly(self, detected: bool) -> None:
        """Stop learning when an anomaly is detected, resume when it is reset.

        The last network that explained the arm is published again, if that is another one.
        """
        self._rests.set_anomaly(detected)
        before = self.gate.anomaly(detected, self._gate_time)
        if before is not None:
            # A calibrated detector may be of the arm before a muscle was changed.
            self._use(self._numbered(before if self._statistics_hold else uncalibrated(before)))
        self._tell_isolated()

    @property
    def isolated(self) -> tuple[int, ...]:
        """The isolated muscles, places in T and l."""
        return self.gate.isolated

    @property
    def _used(self) -> Bools:
        used = np.ones(self.robot.muscle_count, dtype=bool)
        used[list(self.isolated)] = False
        return used

    def isolate(self, muscles: Iterable[int]) -> None:
        """Learn nothing of these muscles, and of all others as before; samples so far stay."""
        muscles = tuple(sorted(muscles))
        if muscles == self.isolated:
            return
        self.gate.isolated = muscles
        self.gate.forget()
        self._rests.reset()
        if (self._spoiled & self._used).any():
            self._healthy.clear()
            self._spoiled[:] = False
        self._news = True
        self._tell_isolated()

    def _tell_isolated(self) -> None:
        """Publish a network that knows, but not while a suspect is verified."""
        mae = self._mae
        if mae is not None and mae.isolated != self.isolated and not self._rests.anomaly:
            self._use(self._numbered(mae))

    def zeros(self, known: bool) -> None:
        """Take lengths from other zeros; nothing is learned of them while those are not known."""
        self.reset()
        self.gate.forget()
        self._zeroed = known

    def enable(self, enabled: bool) -> None:
        """Stop or resume learning; samples and network stay; an update under way is not used."""
        if enabled and not self.enabled:
            self.reset()
        self.enabled = enabled

    def reset(self) -> None:
        """Forget what is no sample yet, as after a backward jump of the clock."""
        self._pairing.reset()
        self._rests.reset()
        self._torque.reset()

    # -- samples → checkpoints ------------------------------------------------------------------

    def poll(self, now: float) -> bytes | None:
        """Begin and end updates at `now` [s]; return a checkpoint if one is to be published."""
        if (
            self._news
            and not _lately(self._begun, now)
            and self.enabled
            and not self._rests.anomaly
            and len(self.samples) >= self._least_samples
            and self.training.ready
        ):
            self._news = self.updates + 1 < self._updates_to_repeat
            self._begun, self._forgot = now, False
            seen, healthy = self.samples.observations(), self._healthy.healthy()
            job = Job(seen, healthy, self._statistics_hold, self._steps, self.isolated)
            self.training.submit(job)
        update = self.training.poll()
        if update is not None and (self._rests.anomaly or not self.enabled):
            self._news = True  # a network that is stopped stays, and it may know an anomaly's arm
        elif update is not None:
            self._take(update)
        self._keep(changed=False)
        if not self._to_publish or _lately(self._given, now):
            return None
        self._to_publish, self._given = False, now
        self.published += 1
        return self.checkpoint

    def _take(self, update: Update) -> None:
        """Use what came of an update."""
        self.last_update, self.updates = update, self.updates + 1
        # Its statistics may be of the arm before a muscle was changed.
        mae = uncalibrated(update.mae) if self._forgot or update.changed else update.mae
        self._statistics_hold |= is_calibrated(mae)
        for muscle, newest in update.changed:
            self._forget(muscle, newest)
        if not self.training.preset.gated or self._passes(mae):
            self._use(self._numbered(mae))

    def _passes(self, mae: Mae) -> bool:
        try:
            self.gate.check(mae)
        except GateError as error:
            self.refused, self.last_refused = self.refused + 1, str(error)
            return False
        return True

    def _numbered(self, mae: Mae) -> Mae:
        before = 0 if self._mae is None else self._mae.version
        return replace(mae, version=1 + max(mae.version, before))

    def _use(self, mae: Mae) -> None:
        self._mae = mae = self._torque.use(mae.without(self.isolated))
        self.checkpoint = checkpoint.to_bytes(mae)
        self.gate.take(mae, self._gate_time)
        # What is published is on disk before it leaves.
        self._keep()
        self._to_publish = True

    def relearn(self, muscles: Iterable[int]) -> None:
        """Learn the constants of muscles anew from what comes.

        The detector is uncalibrated until enough of the changed arm has been seen.
        """
        for muscle in muscles:
            self._forget(muscle)
            self._rests.reset()
        if not self._statistics_hold and self._mae is not None and is_calibrated(self._mae):
            self._use(self._numbered(uncalibrated(self._mae)))
        self._keep()

    def _forget(self, muscle: int, newest: int = 0) -> None:
        """Let all samples but the newest ones say nothing about a muscle."""
        self.samples.forget(muscle, newest)
        self._healthy.clear()
        self._statistics_hold, self._forgot, self._news = False, True, True

    # -- the state ------------------------------------------------------------------------------

    def begin(self, mae: Mae) -> None:
        """Go on from a network, where none was saved; samples stay.

        Raises:
            GateError: If it does not explain the arm.
        """
        self.gate.check(mae)
        self._go_on_from(self._numbered(mae))

    def _go_on_from(self, mae: Mae) -> None:
        self.gate.isolated = mae.isolated
        self._statistics_hold, self._given = True, -math.inf
        self.training.begin(mae)
        self._use(mae)

    def replace(self, mae: Mae | None) -> None:
        """Start anew from a network, or without; what was learned so far is kept as a backup.

        Raises:
            StateError: If the backup cannot be made; nothing is changed then.
            GateError: If the network does not explain the arm; nothing is changed then.
        """
        if mae is not None:
            self.gate.check(mae)
        if self._state is not None and (self.samples or self.checkpoint):
            self._state.back_up(self.samples, self.checkpoint)
        successor = None
        if mae is not None:  # whom the estimator isolated is so for every network
            successor = self._numbered(mae.without({*mae.isolated, *self.isolated}))
        self.training.close()
        self.samples.clear()
        self._healthy.clear()
        self._spoiled[:], self._updates_to_repeat, self.last_update = False, 0, None
        self.reset()
        self.gate.start()
        self._torque.start()
        self._mae, self.checkpoint, self._to_publish = None, None, False
        if successor is None:
            self._keep()
        else:
            self._go_on_from(successor)

    def _load(self) -> Mae | None:
        """Fill the store with the saved samples; return the saved network if it is usable."""
        if self._state is None:
            return None
        saved = self._state.load(self.samples)
        if saved is None or not self.training.preset.gated or self._passes(saved):
            return saved
        self._state.back_up(self.samples, checkpoint.to_bytes(saved), self.last_refused)
        self._keep()  # without the network, or each start would make another backup
        return None

    def save(self) -> Path:
        """Save samples and network at once; return where.

        Raises:
            StateError: If there is no directory, or it cannot be written.
        """
        if self._state is None:
            raise StateError("state_directory is '': nothing is kept; start with a directory")
        self._state.save(self.samples, self.checkpoint)
        return self._state.directory

    def _keep(self, changed: bool = True) -> None:
        if self._state is not None:
            self._state.keep(self.samples, self.checkpoint, changed)

    def close(self) -> None:
        """End the training process and release the directory."""
        self.training.close()
        if self._state is not None:
            self._state.close()

    # -- what there is to say -------------------------------------------------------------------

    @property
    def mae(self) -> Mae:
        """The network as learned so far; only where there is a `checkpoint`."""
        assert self._mae is not None
        return self._mae

    @property
    def trouble(self) -> str:
        """Why nothing is learned, or what is learned is not on disk; or ''."""
        disk = '' if self._state is None else self._state.trouble(self.samples)
        return '; '.join(filter(None, (self.training.trouble, disk)))

    def report(self) -> Report:
        """Return how it is, for /diagnostics."""
        level: Level = 'warn'
        if trouble := self.trouble:
            level, message = 'error', trouble
        elif self.checkpoint is None:
            message = 'waiting for a checkpoint: set the parameter `checkpoint`'
        elif not self.enabled:
            message = 'stopped by learner/enable'
        elif not self._zeroed:
            message = 'waiting until the estimator has found the length zeros'
        elif self._rests.anomaly:
            message = 'stopped by an anomaly until estimator/reset'
        else:
            level, message = 'ok', 'learning'
        return Report(level, message, {**self._values(), 'state': message})

    def _values(self) -> dict[str, str]:
        values = {
            'samples': str(len(self.samples)),
            'accepted': str(self.samples.accepted),
            'checkpoints': str(self.published),
            'checkpoint version': str(0 if self._mae is None else self._mae.version),
            'preset': self.training.preset.name,
            'healthy time': f'{self._healthy.time:.0f} s',
            **self.training.values(),
        }
        if self.isolated:
            values['isolated muscles'] = self.robot.names(self.isolated)
        if self.refused:
            values |= {'refused networks': str(self.refused), 'last refused': self.last_refused}
        if self._state is not None:
            values['state directory'] = str(self._state.directory)
            if self._state.not_used:
                values['saved state not used'] = self._state.not_used
        muscles = self.robot.muscles
        if (update := self.last_update) is not None:
            values |= {
                'error at newest samples': f'{update.error:.4f} rad',
                'loss': f'{update.loss:.4f}',
                'update': f'{update.seconds:.2f} s on {update.device}',
                'anomaly calibrated': str(is_calibrated(update.mae)),
            }
            if len(update.noise):
                worst = int(update.noise.argmax())
                values['length noise'] = f'{1e3 * update.noise[worst]:.2f} mm ({muscles[worst]})'
            if update.contradicted:
                names = self.robot.names(update.contradicted)
                what = 'newest samples contradict several muscles'
                values[what] = f'{names}; look at the joint sensors'
        return values | {f'not learned: {why}': str(n) for why, n in self.rejected.items()}


def _lately(then: float, now: float) -> bool:
    """Whether something was less than `LEAST_INTERVAL` ago; not if the clock went back since."""
    return 0.0 <= now - then < LEAST_INTERVAL
