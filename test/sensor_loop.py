# SPDX-License-Identifier: Apache-2.0
"""A closed loop that controls an emulated arm by its joint sensors, without an estimator."""

from musculoskeletal_ae.experiments.recording import ClosedLoop


class WithJointSensors(ClosedLoop):
    """A loop in which joint sensors replace the estimate."""

    def use(self, mae):
        self.mae = mae
        self.core.use(mae)

    def estimate(self, read, now):  # noqa: ARG002
        return read.theta
