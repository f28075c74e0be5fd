# SPDX-License-Identifier: Apache-2.0
"""Writes learned attachment points into the user's own MJCF file.

Only the positions of sites change. Names, actuators, meshes, comments and the layout of the text
stay, because the text is edited in place and not written anew. Included files are copied with it,
to the same places relative to the file, or beside it if they lie outside its folder. Meshes and
textures are not copied: MuJoCo finds them by absolute paths of their folders, or of single files
that lie beside an included file.
"""

import re
from pathlib import Path

import mujoco
import numpy as np

from musculoskeletal_ae.arrays import Array
from musculoskeletal_ae.exceptions import MusculoskeletalError
from musculoskeletal_ae.importing.source import names_of_all
from musculoskeletal_ae.robot.description import RoutePoint
from musculoskeletal_ae.robot.robot import Robot

COMMENT = re.compile(r'<!--.*?-->', re.DOTALL)
SITE = re.compile(r'<site\b[^>]*>')
INCLUDE = re.compile(r'<include\b[^>]*?\bfile\s*=\s*["\']([^"\']*)["\'][^>]*>')
COMPILER = re.compile(r'<compiler\b[^>]*>')
ATTRIBUTE = r'\b{name}\s*=\s*(["\'])(.*?)\1'
ASSET = re.compile(r'<(mesh|hfield|skin|texture)\b[^>]*>')
ASSET_FILE = re.compile(r'\bfile\w*\s*=\s*(["\'])(.*?)\1')
FOLDERS = 'meshdir', 'texturedir', 'assetdir'
#: identifies a place: the link, and the position there in units of 1e-7 m
Place = tuple[str, tuple[int, ...]]
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
        self._read(self.file)
        self.sites = self._movable_sites()

    def _read(self, file: Path) -> None:
        if file in self.texts:
            return
        self.texts[file] = file.read_bytes().decode('utf-8')  # the ends of its lines stay
        for match in INCLUDE.finditer(_without_comments(self.texts[file])):
            self._read(self._included(file, match[1]))

    def _included(self, file: Path, name: str) -> Path:
        """Return the path of an included file; `name` is relative to the main file or to `file`."""
        beside = (self.file.parent / name, file.parent / name)
        return next((path.resolve() for path in beside if path.is_file()), beside[0].resolve())

    def _movable_sites(self) -> dict[str, Array]:
        """Return the positions [m], by name, of the sites that an edit of the MJCF file can move.

        These are the sites of which the file states the position that they have in the compiled
        model. For a site in a `frame` or a replica, or one that `fromto` places, the file states
        another position.
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

    def sites_of(self, robot: Robot) -> list[list[str | None]]:
        """Return the site of each muscle's route points; None for a site that cannot be moved.

        `robot` was imported from the file. Its route points are in the order of the tendons' sites.
        """
        model, paths = self.model, dict[str, list[tuple[Place, str]]]()
        links = names_of_all('body', (model.body(i).name for i in range(model.nbody)))
        muscles = names_of_all('tendon', (model.tendon(i).name for i in range(model.ntendon)))
        for t, muscle in enumerate(muscles):
            items = slice(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
            is_site = model.wrap_type[items] == mujoco.mjtWrap.mjWRAP_SITE
            paths[muscle] = [
                (place(links[model.site_bodyid[i]], model.site_pos[i]), model.site(i).name)
                for i in model.wrap_objid[items][is_site].tolist()
            ]
        result = list[list[str | None]]()
        for muscle, route in zip(robot.muscles, robot.description.routes, strict=True):
            path, names, start = paths.get(muscle, []), list[str | None](), 0
            for point in (item for item in route if isinstance(item, RoutePoint)):
                here = place(point.link, point.xyz)
                k = next((k for k in range(start, len(path)) if path[k][0] == here), None)
                name = None if k is None else path[k][1]
                names.append(name if name in self.sites else None)
                start = start if k is None else k + 1
            result.append(names)
        return result

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
                return
        raise KeyError(name)

    def write(self, folder: Path) -> Path:
        """Write the file and all files that it includes into a folder; return its path there.

        Raises:
            MusculoskeletalError: If MuJoCo does not load the result.
        """
        copies, folders = self._copies(), self._asset_folders()
        texts = {file: self._placed_elsewhere(file, copies, folders) for file in self.texts}
        model = self.model
        # The default of an unstated folder is that of the file, and the copy lies elsewhere.
        is_used = {'meshdir': model.nmesh or model.nhfield or model.nskin, 'texturedir': model.ntex}
        unstated = [key for key, used in is_used.items() if used and key not in folders]
        if unstated and 'assetdir' not in folders:
            stated = ' '.join(f'{key}="{self.file.parent}"' for key in unstated)
            text = texts[self.file]
            end = '\r\n' if '\r\n' in text else '\n'
            head = re.compile(r'(<mujoco\b[^>]*>)')
            texts[self.file] = head.sub(rf'\1{end}  <compiler {stated}/>', text, count=1)
        for file, text in texts.items():
            copy = folder / copies[file]
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(text.encode('utf-8'))
        result = folder / copies[self.file]
        try:
            mujoco.MjModel.from_xml_path(str(result))
        except (ValueError, mujoco.FatalError) as error:
            problem = f'MuJoCo does not load the copy: {" ".join(str(error).split())}'
            raise MusculoskeletalError(f'{self.file}: {problem}') from error
        return result

    def _copies(self) -> dict[Path, str]:
        """Return the path of each file's copy, relative to the folder of the copies."""
        home = self.file.parent.resolve()
        copies = {self.file: self.file.name}
        for file in self.texts:
            is_inside = file.is_relative_to(home)
            name = file.relative_to(home).as_posix() if is_inside else file.name
            while file != self.file and name in copies.values():
                name = f'included_{name}'
            copies.setdefault(file, name)
        return copies

    def _asset_folders(self) -> dict[str, Path]:
        """Return the folders of assets that the files state, by the name of the attribute."""
        folders = dict[str, Path]()
        for text in self.texts.values():
            for match in COMPILER.finditer(_without_comments(text)):
                for key in FOLDERS:
                    if stated := _attribute(match[0], key):
                        folders[key] = (self.file.parent / stated).resolve()
        return folders

    def _placed_elsewhere(
        self, file: Path, copies: dict[Path, str], folders: dict[str, Path]
    ) -> str:
        """Return the text of a file's copy, with adapted paths of included files and assets."""
        text = self.texts[file]
        plain, edits = _without_comments(text), list[tuple[int, int, str]]()
        for match in INCLUDE.finditer(plain):
            edits.append((*match.span(1), copies[self._included(file, match[1])]))
        for match in COMPILER.finditer(plain):
            for key in FOLDERS:
                if inside := re.search(ATTRIBUTE.format(name=key), match[0]):
                    start, end = (match.start() + at for at in inside.span(2))
                    absolute = (self.file.parent / inside[2]).resolve()
                    edits.append((start, end, str(absolute)))
        # MuJoCo looks for an asset in the folder of assets, and then beside the including file.
        # Only an asset of the second kind needs another path.
        for match in ASSET.finditer(plain):
            key = 'texturedir' if match[1] == 'texture' else 'meshdir'
            place = folders.get(key) or folders.get('assetdir') or self.file.parent
            for inside in ASSET_FILE.finditer(match[0]):
                beside = (file.parent / inside[2]).resolve()
                if beside.is_file() and not (place / inside[2]).is_file():
                    start, end = (match.start() + at for at in inside.span(2))
                    edits.append((start, end, str(beside)))
        for start, end, new in sorted(edits, reverse=True):
            text = text[:start] + new + text[end:]
        return text


def place(link: str, xyz: Array) -> Place:
    """Return a position of a link [m], (3,), as a value that can be compared."""
    return link, tuple(np.rint(1e7 * xyz).astype(int).tolist())


def _without_comments(text: str) -> str:
    """Return a text of the same length in which comments are blank."""
    return COMMENT.sub(lambda match: ' ' * len(match[0]), text)


def _attribute(tag: str, name: str) -> str | None:
    match = re.search(ATTRIBUTE.format(name=name), tag)
    return match[2] if match else None
