"""The fault that each module of hard cases was seen to catch: a guard of the program, and the same line without it.

test_mutations.py holds the lines to the sources; `make bench` puts each fault into a copy of the program and sees the
module fail.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutation:
    """One fault."""

    module: str  # of tests/hard_cases, without ".py"
    file: str  # of the program, from its root
    guard: str  # stands once in the file
    fault: str  # in its place
    select: str = ""  # pytest -k: the tests that see it, where the module is long


MUTATIONS: tuple[Mutation, ...] = (
    Mutation(
        "test_hostile_input",
        "bstcad/scene/errors.py",
        "        super().__init__(one_line(sentence))",
        "        super().__init__(sentence)",
        "long_scene",
    ),
    Mutation(
        "test_hostile_input", "bstcad/scene/scene.py", "    if depth > DEEPEST:", "    if depth > 10**6:", "long_scene"
    ),
    Mutation(
        "test_hostile_input",
        "bstcad/step_text/syntax.py",
        "        rows = np.searchsorted(self.numbers, numbers).clip(max=len(self.numbers) - 1)",
        "        rows = np.zeros(numbers.max() + 1, int)[numbers]",
        "wide_number",
    ),
    Mutation(
        "test_hostile_input",
        "bstcad/step_text/syntax.py",
        '    *bodies, rest = section.split(";")\n    found = [STATEMENT.fullmatch(body) for body in bodies]',
        '    rest = ""\n    found = list(re.finditer(STATEMENT.pattern.replace(".*", "[^;]*") + ";", section))',
        "square",
    ),
    Mutation(
        "test_hostile_input",
        "bstcad/step_text/part21.py",
        "    except (IndexError, KeyError, AttributeError) as error:",
        "    except KeyError as error:",
        "wrong_input and part21 and not hundred",
    ),
    Mutation(
        "test_hostile_input",
        "bstcad/scene/picture.py",
        "    except Exception as error:  # OSError",
        "    except OSError as error:  # OSError",
        "wrong_input and picture and not hundred",
    ),
    Mutation(
        "test_hostile_files",
        "bstcad/scene/picture.py",
        '*(_coded(data) if image.format == "HEIF" else ())',
        "*()",
        "claims and heic",
    ),
    Mutation(
        "test_hostile_paths",
        "bstcad/files.py",
        "    os.replace(new, path)",
        "    path.write_bytes(data)",
        "links",
    ),
    Mutation(
        "test_hostile_files",
        "bstcad/files.py",
        "    if member.file_size > 8 * math.prod(shape) + HEADER or",
        "    if",
        "unfold",
    ),
    Mutation(
        "test_hostile_step",
        "bstcad/step_text/orientation.py",
        "    return (*_faces(entities, back, front), *_edges(entities), *_loops(entities))",
        "    return ()",
        "place",
    ),
    Mutation(
        "test_01_lost_rays",
        "bstcad/optics/interfaces.py",
        "_capped_root(torch.where(total, torch.ones_like(cos2), cos2))",
        "_capped_root(cos2)",
    ),
    Mutation(
        "test_01_lost_rays",
        "bstcad/optics/interfaces.py",
        "x, y, z = torch.where(found, start + s * rays.direction, torch.zeros_like(start))",
        "x, y, z = start + s * rays.direction",
    ),
    Mutation("test_02_critical_angle", "bstcad/optics/interfaces.py", "cos.clamp(min=SKIMMING)", "cos"),
    Mutation("test_02_critical_angle", "bstcad/optics/kernels/crossing.py", "/ max(cos_out, skimming)", "/ cos_out"),
    Mutation("test_03_grazing", "bstcad/optics/surfaces.py", "(x * x + y * y) > EQUATOR", "(x * x + y * y) > -1e9"),
    Mutation("test_03_grazing", "bstcad/optics/intersection.py", "LEVEL = 1e-2", "LEVEL = 1e-9"),
    Mutation("test_04_one_miss", "bstcad/optics/intersection.py", "if 2 * left < s.numel():", "if left < 0:"),
    Mutation(
        "test_05_two_roots",
        "bstcad/optics/intersection.py",
        "rays.alive & ~((dz if rays.sense > 0 else -dz) > known",
        "rays.alive & ((dz if rays.sense > 0 else -dz) < -2 * known",
    ),
    Mutation(
        "test_05_two_roots",
        "bstcad/optics/kernels/ray_blocks.py",
        "steep = not dz > faces.steepest_x",
        "steep = dz < -2 * faces.steepest_x",
    ),
    Mutation("test_06_knots", "bstcad/optics/spline_basis.py", "inner.detach().nan_to_num(0.0)", "inner.detach()"),
    Mutation("test_06_knots", "bstcad/optics/kernels/spline.py", "k, s = m - 3,", "k, s = m - 2,"),
    Mutation(
        "test_07_flat_sphere",
        "bstcad/optics/surfaces.py",
        "return c * r2 / (1 + root)",
        "return (1 - root) / (c + 1e-30)",
    ),
    Mutation(
        "test_08_throw",
        "bstcad/optics/rays.py",
        "self.position[2] + (self.z - z)",
        "(self.position[2] + self.z) - z",
    ),
    Mutation("test_properties", "bstcad/optics/spline_basis.py", "torch.where(k == m - 3, 1.0, 0.5)", "0.5 + 0.0 * u"),
    Mutation("test_properties_trace", "bstcad/optics/simulation.py", "+= 1.0 - launched / whole", "+= 0.0"),
    Mutation("test_properties_scene", "bstcad/scene/target.py", 'extra="forbid", allow', 'extra="ignore", allow'),
    Mutation(
        "test_09_exact_sums",
        "bstcad/optics/kernels/reductions.py",
        "own = torch.empty((count, rows, columns), dtype=torch.float64)",
        "own = torch.empty((count, rows, columns), dtype=torch.float32)",
    ),
    Mutation(
        "test_09_exact_sums",
        "bstcad/optics/spline_basis.py",
        "net = heights.reshape(-1).double()",
        "net = heights.reshape(-1)",
        select="control_point",
    ),
    Mutation(
        "test_10_chunks_and_threads",
        "bstcad/optics/kernels/reductions.py",
        "return min(PARTS, 1 << max(0, (n // LEAST).bit_length() - 1))",
        "return torch.get_num_threads()",
        select="threads_of_one_process or same_design",
    ),
    Mutation(
        "test_10_chunks_and_threads",
        "bstcad/optics/kernels/reductions.py",
        "return flat[:whole].view(-1, ROW).sum(1).sum() + flat[whole:].sum()",
        "return flat.sum()",
        select="threads_of_one_process",
    ),
    Mutation(
        "test_10_chunks_and_threads",
        "bstcad/optics/intersection.py",
        "64 * half * torch.finfo(dtype).eps",
        "64 * 5000 * torch.finfo(dtype).eps",
        select="compiled_or_not",
    ),
    Mutation(
        "test_11_ledger",
        "bstcad/optics/irradiance.py",
        "inside = rays.alive & screen.contains(rays.position[0], rays.position[1])",
        "inside = rays.alive",
    ),
    Mutation(
        "test_11_ledger",
        "bstcad/optics/irradiance.py",
        '"lost through the sides": (Status.VIGNETTED,),',
        '"lost through the sides": (),',
        select="every_ray or simulation",
    ),
    Mutation(
        "test_11_ledger",
        "bstcad/optics/kernels/forward.py",
        "lines[BESIDE] += f",
        "lines[0] += f",
        select="simulation",
    ),
    Mutation(
        "test_12_targets",
        "bstcad/transport/monge_ampere.py",
        "if error > errors[-1]:",
        "if error == np.inf:",
    ),
    Mutation(
        "test_12_targets",
        "bstcad/transport/bfm.py",
        "if coolings == COOLINGS:",
        "if coolings == iterations:",
        select="back_and_forth",
    ),
    Mutation(
        "test_12_targets",
        "bstcad/transport/density.py",
        "if values.max() == 0:",
        "if values.max() < 0:",
        select="sentence",
    ),
    Mutation(
        "test_13_noise_floor",
        "bstcad/report/report.py",
        "return report.rrmsd >= RESOLVED * report.rrmsd_noise",
        "return True",
    ),
    Mutation(
        "test_13_noise_floor",
        "bstcad/optics/sampling.py",
        "y = (jitter_y + j) * (window.height / n) - window.height / 2",
        "y = (jitter_y - 0.5) * window.height + 0 * j",
        select="power",
    ),
    Mutation(
        "test_15_steep_and_thin_solids",
        "bstcad/cad/mesh.py",
        "np.stack([front, back_next, back], axis=1)",
        "np.stack([front, back, back_next], axis=1)",
        select="our_mesh and 129",
    ),
    Mutation(
        "test_15_steep_and_thin_solids",
        "bstcad/cad/step_writing.py",
        'reals.SetFormatForRange("%.14f", 0.1, 1e3)',
        'reals.SetFormatForRange("%.6f", 0.1, 1e3)',
        select="parser and 129",
    ),
    Mutation(
        "test_14_nothing_lost",
        "bstcad/tailoring/minimise.py",
        "if not math.isfinite(merit) or not all(bool(torch.isfinite(g).all()) for g in gradients):",
        "if not math.isfinite(merit):",
        select="gradient",
    ),
    Mutation(
        "test_14_nothing_lost",
        "bstcad/tailoring/minimise.py",
        "standing = search",
        "standing = replace(search, pairs=())",
        select="ctrl_c",
    ),
)
