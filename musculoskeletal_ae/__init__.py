# SPDX-License-Identifier: Apache-2.0
"""Estimate, control and simulate musculoskeletal arms with a musculoskeletal autoencoder."""
