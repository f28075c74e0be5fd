# SPDX-License-Identifier: Apache-2.0
"""Import of robot descriptions in other formats (`import_robot`)."""
