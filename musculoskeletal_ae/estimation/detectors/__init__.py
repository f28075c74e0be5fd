# SPDX-License-Identifier: Apache-2.0
"""The detectors of the health monitor, one file for each sign of a fault."""
