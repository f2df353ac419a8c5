"""A small scene of a dome, as changes of templates/disk.toml."""

SMALL = {
    "name": "dome",
    "source": {"kind": "point", "profile": "lambertian", "position": [0.0, 0.0, 0.0]},
    "lens": {
        "material": "PMMA",
        "front": {"kind": "sphere", "z": 8.0, "curvature": -0.125},
        "back": {"kind": "radial", "radius": 15.0, "half_angle": 60.0, "control_points": 25},
    },
    "target": {"z": 200.0, "x": [-200.0, 200.0], "y": [-150.0, 150.0], "pixels": 24, "uniform": True},
    "tailoring": {"quality": "draft", "rays": 48, "transport_grid": 24, "rounds": 3, "stage2_iterations": 16},
    "accept": {},
}
