# SPDX-License-Identifier: Apache-2.0
"""From raw messages of the muscle modules to the samples that everything else uses."""
