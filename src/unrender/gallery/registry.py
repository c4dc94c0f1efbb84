"""The gallery's problems by name."""

from __future__ import annotations

from typing import Any

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.gallery import fields
from unrender.gallery.ajar import Ajar
from unrender.gallery.boxes import Box2, Box10
from unrender.gallery.bunny import Bunny
from unrender.gallery.caustic import Caustic
from unrender.gallery.chalice import Chalice
from unrender.gallery.exponential import Exponential
from unrender.gallery.fields import Option
from unrender.gallery.glossy_room import GlossyRoom
from unrender.gallery.indirect_room import IndirectRoom
from unrender.gallery.lamp import Lamp
from unrender.gallery.mirror_trio import MirrorTrio
from unrender.gallery.mug import Mug
from unrender.gallery.nerf_volume import NerfVolume
from unrender.gallery.plain_and_textured import PlainAndTextured
from unrender.gallery.poster import Poster
from unrender.gallery.quad import Quad
from unrender.gallery.shadow import Shadow
from unrender.gallery.smoke import Smoke
from unrender.gallery.specification import build_problem
from unrender.gallery.sphere_to_mesh import SphereToMesh
from unrender.gallery.spiral import Spiral
from unrender.gallery.sun_glossy import SunGlossy
from unrender.gallery.sunlit_vase import SunlitVase
from unrender.gallery.tea import Tea
from unrender.gallery.three_bodies import ThreeBodies
from unrender.gallery.two_planets import TwoPlanets
from unrender.problem.problem import Problem

_RECIPES: dict[str, type] = {
    "indirect-room": IndirectRoom,
    "glossy-room": GlossyRoom,
    "sunlit-vase": SunlitVase,
    "lamp": Lamp,
    "spiral": Spiral,
    "ajar": Ajar,
    "chalice": Chalice,
    "mirror-trio": MirrorTrio,
    "sun-glossy": SunGlossy,
    "plain-and-textured": PlainAndTextured,
    "two-planets": TwoPlanets,
    "caustic": Caustic,
    "exponential": Exponential,
    "quad": Quad,
    "box2": Box2,
    "box10": Box10,
    "mug": Mug,
    "shadow": Shadow,
    "bunny": Bunny,
    "poster": Poster,
    "sphere-to-mesh": SphereToMesh,
    "three-bodies": ThreeBodies,
    "tea": Tea,
    "smoke": Smoke,
    "nerf-volume": NerfVolume,
}

_OWN = (Exponential, Quad, SphereToMesh, NerfVolume)
"""Those that make their problem themselves: no renderer, or references of another scene."""


def names() -> list[str]:
    """The problems there are; the first is the one to begin with."""
    return list(_RECIPES)


def summary(name: str) -> str:
    """One line: what is to be recovered, and from what. Raises `InputError` for an unknown name."""
    return (_specification(name).__doc__ or "").split("\n")[0]


def options(name: str) -> list[Option]:
    """What `problem(name, ...)` may be asked for. Raises `InputError` for an unknown name."""
    return fields.of(_specification(name))


def problem(name: str, **options: Any) -> Problem:
    """A problem made by code, its truth known wherever there is one: its scene, its references (rendered now), where the descent starts.

        problem("indirect-room", resolution=64, texture_resolution=64)

    Args:
        name: one of `names()`.
        options: see `options(name)`. All have loss, those that are rendered resolution (pixels along a side),
            reference_spp and max_depth, and those of unknown textures texture_resolution; the defaults take seconds on two CPU
            cores, a GPU wants larger ones.

    Returns:
        the problem. Its references hold noise of their own, which `reference_spp` lowers.

    Raises:
        InputError: the name or an option is unknown, or an option is out of its range.
        VariantError: Mitsuba cannot run on this machine.
    """
    specification = fields.fill(name, _specification(name), options)
    made = specification.problem(name) if isinstance(specification, _OWN) else build_problem(name, specification)
    made.origin |= {"gallery": name, "options": options}
    return made


def _specification(name: str) -> type:
    if not isinstance(name, str) or name not in _RECIPES:
        hint = did_you_mean(str(name), _RECIPES) or f"; it has {', '.join(_RECIPES)}"
        raise InputError(f"gallery: no problem {name}{hint}")
    return _RECIPES[name]
