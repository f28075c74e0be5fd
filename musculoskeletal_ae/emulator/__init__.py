# SPDX-License-Identifier: Apache-2.0
"""The emulated arm: body, dynamics, muscle modules, heat and faults."""
