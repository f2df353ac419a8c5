"""What a drawing says of a [mount]."""

from bstcad.report.mount_words import rows
from bstcad.scene.mount import Box, Flange, Mount, Round, Screws


def test_a_flange_with_all_that_it_can_have():
    flange = Flange(
        outline=Box(shape="rectangle", width=26.0, height=24.5, corner_radius=3.0), z=15.5, thickness=1.5, draft=1.0,
        bevel=0.2, screws=Screws(count=4, diameter=2.2, circle=28.0), holes=((1, 11, 0.9), (-1, 11, 0.9), (0, -11, 2)),
    )  # fmt: skip
    rim = Round(shape="circle", diameter=15.0)
    said = list(rows(Mount(datum="flange", rim=rim, draft=2.0, bevel=0.15, flange=flange)))
    assert said == [
        ("Its z = 0", "the flange's lower face"),
        ("Rim cut to", "Ø15 mm"),
        ("Lens's walls", "draft 2°, bevel 0.15 mm"),
        ("Flange", "26 × 24.5, R3 mm"),
        ("", "z = 15.5 to 17 mm here"),
        ("Its walls", "draft 1°, bevel 0.2 mm"),
        ("Screw holes", "4 × Ø2.2 on Ø28 mm, from 90°"),
        ("Holes", "2 × Ø0.9 mm, see part.step"),
        ("Holes", "1 × Ø2 mm, see part.step"),
    ]
    assert list(rows(Mount(bevel=0.2))) == [("Its z = 0", "as on this sheet"), ("Lens's walls", "bevel 0.2 mm")]
    assert list(rows(None)) == []
