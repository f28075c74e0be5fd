# SPDX-License-Identifier: Apache-2.0
"""`python -m bench` lists the benches; `python -m bench NAME [options]` runs one.

A bench is a module of this folder with a `main(argv)` that returns an exit status, or None for 0.
Errors of the package are reported in one line, with status 1, like those of a tool.
"""

import ast
import importlib
import sys
from pathlib import Path

from musculoskeletal_ae.options import exit_status
from musculoskeletal_ae.output import secure_output
from musculoskeletal_ae.process_signals import STOP, Reaction


def benches() -> dict[str, str]:
    """Return the first line of every bench's docstring, by name."""
    lines = {}
    for file in sorted(Path(__file__).parent.glob('[!_]*.py')):
        tree = ast.parse(file.read_text(encoding='utf-8'))
        if any(isinstance(part, ast.FunctionDef) and part.name == 'main' for part in tree.body):
            lines[file.stem] = (ast.get_docstring(tree) or '').partition('\n')[0]
    return lines


def main(argv: list[str]) -> int:
    """List the benches or run one; return status 2 for an unknown name."""
    listed = benches()
    if not argv or argv[0] in ('-h', '--help'):
        print(
            'Usage: python -m bench NAME [options]. Each bench has --help;\n'
            'bench/README.md states when a bench passes.\n'
        )
        print('\n'.join(f'{name:<20}{line}' for name, line in listed.items()))
        return 0
    if argv[0] not in listed:
        print(f'error: unknown bench {argv[0]!r}; legal: {", ".join(listed)}', file=sys.stderr)
        return 2
    return exit_status(lambda: importlib.import_module(f'bench.{argv[0]}').main(argv[1:]))


if __name__ == '__main__':
    secure_output()
    STOP.install(Reaction.RAISE)  # SIGTERM then ends a bench and its child processes as Ctrl-C does
    sys.exit(main(sys.argv[1:]))
