# SPDX-License-Identifier: Apache-2.0
"""Export of a learned body in other formats."""
