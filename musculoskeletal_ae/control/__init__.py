# SPDX-License-Identifier: Apache-2.0
"""From a target to a command that the arm can follow safely."""
