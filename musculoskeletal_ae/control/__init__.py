# SPDX-License-Identifier: Apache-2.0
"""Control: decides what the arm may do, and checks every command.

`controller` connects the parts; begin there. `watchdog` detects stop causes, which `conditions.py`
declares, and `supervisor` decides what follows. `activities` is the interface of everything that
the arm can do; `motion/` implements it. `stop_commands` computes the commands while the arm is
stopped. Every command finally passes the `limiter`. `controller_status` reports to users and
programs.
"""
