# SPDX-License-Identifier: Apache-2.0
"""What the arm is: description, geometric lengths, muscle Jacobian, gravity, elasticity, checks."""
