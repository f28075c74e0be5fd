# SPDX-License-Identifier: Apache-2.0
"""The detectors of the health monitor, one for each kind of fault."""
