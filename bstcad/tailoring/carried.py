"""Carry the light of an earlier lens over to a lens that differs a little: each ray lands where it landed before.

Both lenses have the same last net, but another front, thickness or index, so that a ray meets this net elsewhere and in
another direction.  At points b of the net the slope p(b, t) that sends the new ray to the target point t of the earlier
ray follows from Snell's law in closed form (reach.py).  A least-squares fit adds the change of the slopes to the net.
The change is smooth even if the net is not: one fit on a coarse grid does for a relief of any fineness.  The rays
through b come from elsewhere on the source's cone, so that the flux at t changes a little; stage 2 corrects this.
"""

from __future__ import annotations

import torch

from bstcad.optics.lens.lens import Lens
from bstcad.optics.light.emitters import Emitter
from bstcad.optics.receivers.goal import Goal
from bstcad.optics.trace.reach import wanted_slopes
from bstcad.optics.trace.trace import behind
from bstcad.optics.trace.unfolding import image_screen
from bstcad.tailoring.slope_fit import Fit, fit_slopes
from bstcad.tailoring.slope_map import face_grid, lit_window

CELLS = 128  # points per side of the grid
FIT = Fit(bending=1e-3, steps=20, degree=5)  # fit of the change


@torch.no_grad()
def carry_light(source: Emitter, before: Lens, after: Lens, goal: Goal) -> Lens:
    """Return `after`, whose last net is that of `before`, with slopes that send each ray where it landed before.

    source: with the index of both lenses set for its wavelength.  goal: target, for its receiver.
    """
    window = lit_window(source, after)
    seen, receiver = (image_screen(lens, goal.screen).receiver for lens in (before, after))
    old, new = (face_grid(source, lens, window, CELLS) for lens in (before, after))
    landed = seen.land(behind(old.at_face, before.last_tailored))
    aim = torch.stack(list(landed.position))
    lit = (old.density > 0) & (new.density > 0) & landed.alive
    needed = wanted_slopes(new.at_face, torch.where(lit, aim, torch.zeros_like(aim)), receiver, after.last_tailored.law)
    x, y, z_x, z_y = (part[lit] for part in (*new.at_face.places, *needed))
    net = after.nets[-1]
    fitted = fit_slopes(net, x, y, z_x=z_x, z_y=z_y, weight=torch.ones_like(x), fit=FIT)
    return after.with_last_net(fitted.from_vertex().moved(net.z))
