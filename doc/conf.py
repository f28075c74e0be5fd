# SPDX-License-Identifier: Apache-2.0
"""Configures Sphinx for the web site of these pages, with a reference made from the docstrings.

.venv/bin/pip install -r doc/requirements.txt
.venv/bin/python -m sphinx -W doc build/doc      # then open build/doc/index.html
"""

import os
import re
import sys
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.ext import apidoc

FOLDER = Path(__file__).resolve().parent
PACKAGE = FOLDER.parent / 'musculoskeletal_ae'
sys.path.insert(0, str(PACKAGE.parent))

project = 'musculoskeletal_ae'
author = 'the authors of musculoskeletal_ae'
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx.ext.viewcode']
exclude_patterns = ['requirements.txt']
html_theme = 'furo'
html_title = project
myst_heading_anchors = 3
autodoc_member_order = 'bysource'
autodoc_typehints = 'description'
# Only nodes/, ros/, ros_tools/ and the page need these, and neither is part of the reference.
autodoc_mock_imports = ['rclpy', 'viser']
#: fields of records are explained where they are defined; napoleon would list them twice
napoleon_use_ivar = True
# The diagram of stops.md is drawn by GitHub; here it is shown as text.
suppress_warnings = [
    'autodoc.mocked_object',
    'ref.python',
    'myst.xref_missing',
    'misc.highlighting_failure',
]


def write_reference(_: Sphinx) -> None:
    """Write one page for each folder of the package, except those without a public API."""
    left_out = [
        str(PACKAGE / room) for room in ('nodes', 'ros', 'ros_tools', 'tools', 'view', 'importing')
    ]
    out = str(FOLDER / 'modules')
    apidoc.main(['-f', '-q', '-T', '-M', '-d', '1', '-o', out, str(PACKAGE), *left_out])


def name_files(_: Sphinx, page: str, source: list[str]) -> None:
    """Replace links to files outside doc/, which the site does not contain, by their paths."""

    def replaced(link: re.Match[str]) -> str:
        text, target = link.groups()
        path = os.path.relpath(FOLDER / Path(page).parent / target.partition('#')[0], FOLDER.parent)
        if path.startswith(f'{FOLDER.name}{os.sep}'):
            return link[0]
        return f'`{path}`' if text.strip('`') == path else f'{text} (`{path}`)'

    source[0] = re.sub(r'(?<!!)\[([^\]]+)\]\((\.\./[^)\s]+)\)', replaced, source[0])


def as_written(*event: Any) -> None:
    """Show docstrings as they are written, although Sphinx reads them as reStructuredText.

    Vertical bars and asterisks are escaped, `code` becomes literal text, and indented blocks become
    equations.
    """
    lines: list[str] = event[-1]
    text = re.sub(r'(?<!`)`([^`]+)`(?!`)', r'``\1``\ ', '\n'.join(lines))
    equation = False
    new: list[str] = []
    for line in text.split('\n'):
        begins = line.startswith('    ') and new[-1:] == [''] and not equation
        equation = begins or (equation and line[:1] in ('', ' '))
        if begins:
            new += ['::', '']
        new.append(line if equation else re.sub(r'(?<!\*)([|*])(?!\*)', r'\\\1', line))
    lines[:] = new


def setup(app: Sphinx) -> None:
    """Let Sphinx write the reference before it reads the pages, and adapt pages and docstrings."""
    app.connect('builder-inited', write_reference)
    app.connect('source-read', name_files)
    app.connect('autodoc-process-docstring', as_written, priority=400)  # before napoleon
