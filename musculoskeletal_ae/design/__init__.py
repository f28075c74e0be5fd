# SPDX-License-Identifier: Apache-2.0
"""Help in designing an arm; nothing of it runs while an arm moves."""
