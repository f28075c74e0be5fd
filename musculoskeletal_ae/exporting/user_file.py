# SPDX-License-Identifier: Apache-2.0
"""Writes learned attachment points into the user's own MJCF file.

Only the positions of sites change. Names, actuators, meshes, comments and the layout of the text
stay, because the text is edited in place and not written anew. Included files are copied into the
same folder if a site in them moves; otherwise the copy includes the original. Folders of meshes and
textures become absolute paths, because the copy lies elsewhere.
"""

import re
from pathlib import Path

import mujoco
import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.exporting.learned_routes import Place

COMMENT = re.compile(r'<!--.*?-->', re.DOTALL)
SITE = re.compile(r'<site\b[^>]*>')
INCLUDE = re.compile(r'<include\b[^>]*?\bfile\s*=\s*["\']([^"\']*)["\'][^>]*>')
COMPILER = re.compile(r'<compiler\b[^>]*>')
ATTRIBUTE = r'\b{name}\s*=\s*(["\'])(.*?)\1'
FOLDERS = 'meshdir', 'texturedir', 'assetdir'
SAME = 1e-6  # regard a site as unchanged if it has moved by no more than this [m]


class UserFile:
    """An MJCF file with its included files, as texts that can be changed."""

    def __init__(self, file: Path) -> None:
        """Read the file and all files that it includes.

        Raises:
            MusculoskeletalError: If MuJoCo cannot load the file, or if it cannot be read.
        """
        self.file = file.absolute()
        try:
            self.model = mujoco.MjModel.from_xml_path(str(self.file))
        except (ValueError, mujoco.FatalError) as error:
            problem = f'MuJoCo cannot load it: {" ".join(str(error).split())}'
            raise MusculoskeletalError(f'{file}: {problem}') from error
        self.texts: dict[Path, str] = {}
        self._changed: set[Path] = set()
        self._read(self.file)
        self.sites = self._movable_sites()

    def _read(self, file: Path) -> None:
        if file in self.texts:
            return
        self.texts[file] = file.read_text(encoding='utf-8')
        for match in INCLUDE.finditer(_without_comments(self.texts[file])):
            self._read(self._included(file, match[1]))

    def _included(self, file: Path, name: str) -> Path:
        """Return an included file, whose name is relative to the main file, or to the includer."""
        beside = (self.file.parent / name, file.parent / name)
        return next((path.resolve() for path in beside if path.is_file()), beside[0].resolve())

    def _movable_sites(self) -> dict[str, Array]:
        """Return the positions of the sites that can be moved by changing the text [m], by name.

        These are the sites whose text states the position that they have in the compiled model. The
        text of a site in a `frame` or a replica, or of one that `fromto` places, states another
        position.
        """
        found = dict[str, list[Array]]()
        for text in self.texts.values():
            for match in SITE.finditer(_without_comments(text)):
                name, at = _attribute(match[0], 'name'), _attribute(match[0], 'pos')
                if name:
                    numbers = [float(word) for word in (at or '0 0 0').split()]
                    found.setdefault(name, []).append(np.array(numbers))
        sites = dict[str, Array]()
        for i in range(self.model.nsite):
            name, place = self.model.site(i).name, self.model.site_pos[i].copy()
            stated = found.get(name, [])
            if len(stated) == 1 and len(stated[0]) == 3 and np.abs(stated[0] - place).max() < SAME:
                sites[name] = place
        return sites

    def places(self, links: dict[str, str]) -> dict[Place, str]:
        """Return the name of each movable site, by its link and its position there.

        Args:
            links: Name of the link of each body, by the name of the body.
        """
        places = dict[Place, str]()
        for name, xyz in self.sites.items():
            body = self.model.body(self.model.site(name).bodyid[0]).name
            if body in links:
                places[links[body], tuple(np.rint(1e7 * xyz).astype(int).tolist())] = name
        return places

    def move(self, name: str, xyz: Array) -> None:
        """Move the site `name` to `xyz` [m], (3,), in the frame of its body, in the file's text."""
        position = ' '.join(f'{value + 0.0:.9g}' for value in np.round(xyz, 9).tolist())
        for file, text in self.texts.items():
            for match in SITE.finditer(_without_comments(text)):
                if _attribute(match[0], 'name') != name:
                    continue
                tag = text[match.start() : match.end()]
                new, count = re.subn(r'\bpos\s*=\s*(["\']).*?\1', f'pos="{position}"', tag, count=1)
                if not count:
                    new = re.sub(r'^<site\b', f'<site pos="{position}"', tag)
                self.texts[file] = text[: match.start()] + new + text[match.end() :]
                self._changed.add(file)
                return
        raise KeyError(name)

    def write(self, folder: Path) -> Path:
        """Write the changed file into a folder; return its path.

        Raises:
            MusculoskeletalError: If MuJoCo does not load the result.
        """
        # A file that includes a changed file must change too, because it names the copy.
        before = -1
        while before != len(self._changed):
            before = len(self._changed)
            for file, text in self.texts.items():
                included = [match[1] for match in INCLUDE.finditer(_without_comments(text))]
                if any(self._included(file, name) in self._changed for name in included):
                    self._changed.add(file)
        self._changed.add(self.file)
        names = dict[Path, str]()
        for file in self.texts:
            name = file.name
            while name in names.values():
                name = f'included_{name}'
            names[file] = name
        is_folder_stated = False
        for file in self._changed:
            text, stated = self._placed_elsewhere(file, names)
            is_folder_stated |= stated
            self.texts[file] = text
        is_folder_stated |= any(
            any(_attribute(match[0], key) for key in FOLDERS)
            for file, text in self.texts.items()
            if file not in self._changed
            for match in COMPILER.finditer(_without_comments(text))
        )
        model = self.model
        has_assets = any((model.nmesh, model.ntex, model.nhfield, model.nskin))
        if has_assets and not is_folder_stated:
            folders = ' '.join(f'{key}="{self.file.parent}"' for key in FOLDERS[:2])
            head = re.compile(r'(<mujoco\b[^>]*>)')
            self.texts[self.file] = head.sub(
                rf'\1\n  <compiler {folders}/>', self.texts[self.file], count=1
            )
        for file in self._changed:
            (folder / names[file]).write_text(self.texts[file], encoding='utf-8')
        result = folder / names[self.file]
        try:
            mujoco.MjModel.from_xml_path(str(result))
        except (ValueError, mujoco.FatalError) as error:
            problem = f'MuJoCo does not load the copy: {" ".join(str(error).split())}'
            raise MusculoskeletalError(f'{self.file}: {problem}') from error
        return result

    def _placed_elsewhere(self, file: Path, names: dict[Path, str]) -> tuple[str, bool]:
        """Return a file's text for another folder, and whether it states the folder of meshes."""
        text, is_stated = self.texts[file], False
        edits = list[tuple[int, int, str]]()
        plain = _without_comments(text)
        for match in INCLUDE.finditer(plain):
            other = self._included(file, match[1])
            name = names[other] if other in self._changed else str(other)
            edits.append((match.start(1), match.end(1), name))
        for match in COMPILER.finditer(plain):
            for key in FOLDERS:
                if inside := re.search(ATTRIBUTE.format(name=key), match[0]):
                    is_stated = True
                    absolute = (self.file.parent / inside[2]).resolve()
                    start = match.start() + inside.start(2)
                    edits.append((start, start + len(inside[2]), str(absolute)))
        for start, end, new in sorted(edits, reverse=True):
            text = text[:start] + new + text[end:]
        return text, is_stated


def _without_comments(text: str) -> str:
    """Return a text of the same length in which comments are blank."""
    return COMMENT.sub(lambda match: ' ' * len(match[0]), text)


def _attribute(tag: str, name: str) -> str | None:
    match = re.search(ATTRIBUTE.format(name=name), tag)
    return match[2] if match else None
