# SPDX-License-Identifier: Apache-2.0
"""The arm that plays reality: body, dynamics, muscle modules, heat, faults."""
