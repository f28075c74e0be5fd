# SPDX-License-Identifier: Apache-2.0
"""Helps to design an arm: checks and remedies. No part of it runs while an arm moves."""
