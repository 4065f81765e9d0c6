"""What a render gives beside its image: layers, an image without noise, pictures on the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from manylights.errors import argument, check, typed
from manylights.loading import light_groups
from manylights.loading.ours import Wish
from manylights.output import channels, images
from manylights.output import denoise as denoising
from manylights.rendering import live
from manylights.rendering.job import Job
from manylights.rendering.state import State


@dataclass(frozen=True)
class Extras:
    """Further arguments of ``manylights.render``.

    Attributes:
        aovs: channels that describe the surfaces in sight, "albedo,normal,depth" or a list:
            ``albedo``, ``normal``, ``geo_normal``, ``position``, ``depth``, ``uv``,
            ``shape_index``, ``prim_index``, ``dp_du``, ``dp_dv``, ``duv_dx``, ``duv_dy``,
            ``emission``. For scenes that are not loaded yet. Default: none.
        light_groups: groups of lights by patterns of ids, as ``"key=lamp_*,windows=facade"`` or
            ``{"key": "lamp_*", "windows": ["facade", "pane_?"]}``, in USD stages of paths of prims,
            as ``"key=/World/Lamps/*"``, or of their names: the image gets layers
            ``RGBA_key.R``, ... with their light, and is the sum of them, bit for bit
            (``output.light_groups``). All other lights are the group ``rest``. For scenes that are
            not loaded yet. Default: what the integrator says.
        denoise: find the image without noise, too, by Open Image Denoise (mitsuba-oidn), from
            ``albedo``, ``normal`` and ``emission`` where the scene is not loaded yet and the
            integrator is ours. The file has it in ``denoised.*``, the PNG shows it, the image
            stays as it is.
        exposure: stops by which the PNG is brighter, from -64 to 64.
        tev: ``HOST:PORT`` (empty: this machine) of the viewer tev, which gets the picture after
            each step, by the package tevclient. Default: none.
    """

    aovs: str | Sequence[str] | None = None
    light_groups: str | Mapping[str, str | list[str]] | None = None
    denoise: bool = False
    exposure: float = 0.0
    tev: str | None = None

    @staticmethod
    def of(arguments: dict[str, Any], part) -> Extras:
        """Return those that were given to ``render``, checked.

        Raises:
            TypeError: there is no such argument.
            UsageError: a value that cannot be, or a package is missing.
        """
        known = [field.name for field in fields(Extras)]
        for name in arguments:
            if name not in known:
                raise TypeError(f"render() got an unexpected keyword argument {name!r}")
        extras = Extras(**arguments)
        images.check_stops(extras.exposure)
        tev = extras.tev
        check("tev", tev, tev is None or isinstance(tev, str), "a text, HOST:PORT")
        if tev is not None:
            live.check(tev)
        for name in ("denoise", "exposure"):
            value = getattr(extras, name)
            whole = not value or part is None
            merge = typed("manylights.merge", "manylights merge")
            check(name, value, whole, f"left out with {argument('part')}, and given to {merge}")
        if extras.denoise:
            denoising.check_installed()
        return extras

    def parameters(self) -> dict[str, str]:
        """Return the parameters of our integrators for the channels that are wanted of them."""
        wanted = denoising.with_guides(self.aovs) if self.denoise else self.aovs
        added = {} if wanted is None else {"aovs": channels.aov_list(wanted)}
        if added and self.aovs is None:
            added["aovs"] = Wish(added["aovs"])
        if self.light_groups is not None:
            added[light_groups.PARAMETER] = light_groups.as_text(self.light_groups)
        return added

    def prepare(self, job: Job, target: Path | None) -> Callable[[State], None] | None:
        """Return what shows a state in tev, ``None`` without.

        Raises:
            UsageError: nobody listens there, or the film has nothing to denoise.
        """
        if self.denoise:
            job.driver.blank()
            denoising.picture_in(job.driver.shown())
        if self.tev is None:
            return None
        viewer = live.Viewer(self.tev, target.name if target else "manylights")
        return lambda state: viewer.show(state, job.driver.adjoint, job.loaded.exposure)

    def add_denoised(self, job: Job, result) -> None:
        """Add the image without noise to a ``RenderResult``, if it is wanted."""
        if not self.denoise:
            return
        names = channels.names(result.bitmap)
        result.denoised = denoising.denoised(result.image, names, job.loaded.exposure)
        if not job.film.rfilter().is_box_filter():
            result.notes.append(
                "denoise: the film's filter spreads noise over pixels, which looks like texture; "
                'with <rfilter type="box"/> less of it is left'
            )
