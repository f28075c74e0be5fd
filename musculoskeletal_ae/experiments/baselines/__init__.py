# SPDX-License-Identifier: Apache-2.0
"""Estimators of joint angles from before the autoencoder, small and honest, on the same data."""
