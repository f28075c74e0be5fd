# SPDX-License-Identifier: Apache-2.0
"""Convert raw messages of the muscle modules to checked samples for all other parts."""
