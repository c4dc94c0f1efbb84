"""Annotations of per-lane arrays.

Mitsuba's stubs treat `mitsuba.Float` and the `drjit.auto.ad.Float` of its methods as different types, likewise the others, and do not
declare the product of a spectrum and a number. A type checker therefore sees any type; a reader sees `mi.Float`, `mi.Bool`, `mi.UInt32`
and `mi.Spectrum`.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import drjit as dr

Float: TypeAlias = Any
Bool: TypeAlias = Any
UInt32: TypeAlias = Any
Spectrum: TypeAlias = Any

while_loop: Any = dr.while_loop
"""`drjit.while_loop`, whose stub only accepts loops of one variable."""
