# SPDX-License-Identifier: Apache-2.0
"""Random deviations of an emulated individual from the MJCF file that describes it.

A built robot never equals its description exactly. The seed draws these differences:

    attachment points    σ = 10 % of the muscle's typical moment arm, at most 5 mm, each coordinate
    tendon lengths       σ = 5 % of the typical moment arm, at most 2 mm
    elastic elements     up to 20 % stiffer or softer
    tendon friction      15 to 20 % of the tension along the route
    joint friction       1.1 to 1.5 % of the joint's largest load by weight and muscles at T_bias
    masses               σ = 10 % of the mass of each body, with its inertia
    tension sensors      gain: σ = 2 %; offset: σ = 10 % of T_bias
    joint sensors        offset: σ = 1°

Both kinds of friction are in addition to the friction in the file. The typical moment arm is the
root mean square over the workspace. The muscles of a finger, which have short moment arms,
therefore deviate by less than the muscles of a shoulder.
"""

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from musculoskeletal_ae.arrays import Array, Bools
from musculoskeletal_ae.emulator.foreign.effects import NONE, Draw, Effects
from musculoskeletal_ae.emulator.foreign.mujoco_model import set_constants
from musculoskeletal_ae.robot.robot import Robot

#: displace points with this standard deviation σ, relative to the typical moment arm
ATTACHMENT = 0.1
FARTHEST = 0.005  # limit σ of the displacement of a point to this [m]
#: draw errors of tendon lengths with this standard deviation σ, relative to the typical moment arm
SLACK = 0.05
LONGEST = 0.002  # limit σ of the error of a tendon's length to this [m]
MASS = 0.1  # multiply masses by random factors whose logarithm has this σ
#: draw offsets of tension sensors with this σ, relative to T_bias: modules that keep a low tension
#: have sensors that can measure it
ZERO = 0.1


def effects(robot: Robot) -> Effects:
    """Return how far an individual's sensors, elastic elements and friction may deviate."""
    return replace(
        NONE,
        stiffness=0.2,
        guide_friction=0.2,
        joint_friction=0.015,
        tension_gain=0.02,
        tension_zero=ZERO * float(np.median(robot.tension.bias)),
        joint_zero=np.radians(1.0),
    )


def slack(robot: Robot, draw: Draw) -> Array:
    """Return a random error of each tendon's length [m], (M,): an offset of its length sensor."""
    sigma = np.minimum(SLACK * robot.routes.typical_arms, LONGEST)
    return sigma * draw.rng('slack').normal(size=len(sigma))


class Attachments:
    """Random displacements of the points (MuJoCo sites) at which tendons are attached to bodies."""

    def __init__(self, robot: Robot, model: Any, draw: Draw) -> None:
        """Move the sites of `model` by random displacements, which are drawn from `draw`.

        The tendons of `model` must have the names of the robot's muscles.
        """
        self._model, self._rest, self._rng = model, model.site_pos.copy(), draw.rng('attachment')
        sigma = np.minimum(ATTACHMENT * robot.routes.typical_arms, FARTHEST)
        self._sites = [_sites(model, model.tendon(name).id) for name in robot.muscles]
        #: σ of each site [m]: the smallest σ of the muscles that pass through it
        self._sigma = np.zeros(model.nsite)
        for own, size in zip(self._sites, sigma.tolist()):
            is_new = self._sigma[own] == 0.0
            self._sigma[own] = np.where(is_new, size, np.minimum(self._sigma[own], size))
        self.move(np.ones(len(self._sites), dtype=bool))

    def move(self, muscles: Bools) -> None:
        """Move the sites of the muscles in the mask `muscles`, (M,), to newly drawn positions.

        A site that would lie inside an object that a tendon wraps around keeps its original
        position.
        """
        own = [self._sites[m] for m in np.flatnonzero(muscles)]
        for s in np.unique(np.concatenate(own)).tolist():
            shift = self._sigma[s] * self._rng.normal(size=3)
            self._model.site_pos[s] = self._rest[s] + shift
            if _is_inside(self._model, s):
                self._model.site_pos[s] = self._rest[s]


def _sites(model: Any, tendon: int) -> Array:
    path = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    of_sites = model.wrap_type[path] == mujoco.mjtWrap.mjWRAP_SITE
    sites: Array = model.wrap_objid[path][of_sites]
    return sites


def _is_inside(model: Any, site: int) -> bool:
    """Return whether a site lies inside a geom of its own body that a tendon wraps around."""
    kinds = mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER
    for w in np.flatnonzero(np.isin(model.wrap_type, kinds)).tolist():
        geom = model.wrap_objid[w]
        if model.geom_bodyid[geom] != model.site_bodyid[site]:
            continue
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        away = turn.reshape(3, 3).T @ (model.site_pos[site] - model.geom_pos[geom])
        if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_CYLINDER:
            away[2] = 0.0
        if np.linalg.norm(away) < 1.001 * model.geom_size[geom][0]:
            return True
    return False


def change_masses(model: Any, draw: Draw) -> None:
    """Multiply mass and inertia of each body of a MuJoCo model by a random factor, in place."""
    factor = np.exp(MASS * draw.rng('masses').normal(size=model.nbody))
    model.body_mass[:] *= factor
    model.body_inertia[:] *= factor[:, None]
    set_constants(model)
