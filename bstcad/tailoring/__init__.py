"""Tailoring of the freeform faces of a lens, in stages (Wang et al. 2023).

Stage 1 computes a transport map from points of the face to slopes and fits the surface to it (stage1.py; two_faces.py
if the front is freeform too).  Stage 2 starts from this surface and minimises the error of the traced irradiance
(stage2.py).  For a source of finite size stage 3 replaces stage 2, or follows it in tailoring/baselines/paper.py.
"""
