"""Draws the road of a scene from above as a picture."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from PIL import Image, ImageDraw, ImageFont

from scenefactory_jax.visualization.birds_eye import drawing, patch_overlay
from scenefactory_jax.visualization.birds_eye.drawing import GROUND, INK, Stroke, View
from scenefactory_jax.visualization.birds_eye.patch_overlay import Area

FINE = 2  # pictures are drawn at this many times their size and reduced


def road_image(lines: Sequence[Stroke], view: View, *, patches: Sequence[Area] = ()) -> Image.Image:
    """Draws a road and its patches in a window, with a 20 m scale bar in the lower left corner."""
    fine = view._replace(pixels=view.pixels * 2)
    image = Image.new("RGB", (fine.pixels, fine.pixels), GROUND)
    draw = ImageDraw.Draw(image)
    scale = fine.pixels / view.side
    first = patch_overlay.count_strokes_below(list(lines))
    for order, stroke in enumerate(lines):
        if order == first:
            _draw_areas(draw, fine, patches)
        width = max(stroke.width * scale, stroke.thinnest * FINE * 2)
        ends = drawing.to_pixels(fine, stroke.lines)
        near = (ends.max(axis=(1, 2)) > -width) & (ends.min(axis=(1, 2)) < fine.pixels + width)
        for (x0, y0), (x1, y1) in ends[near]:
            draw.line((x0, y0, x1, y1), fill=stroke.colour, width=round(width))
            if width > 6:  # round ends close the gaps between the segments of a bend
                for x, y in ((x0, y0), (x1, y1)):
                    draw.ellipse((x - width / 2, y - width / 2, x + width / 2, y + width / 2), fill=stroke.colour)
    if first == len(lines):
        _draw_areas(draw, fine, patches)
    left, low, thick = 0.03 * fine.pixels, 0.97 * fine.pixels, 0.004 * fine.pixels
    draw.rectangle((left, low - thick, left + 20.0 * scale, low), fill=INK)
    draw.text((left, low - 2 * thick), "20 m", font=load_font(round(fine.pixels / 38)), fill=INK, anchor="lb")
    return image.reduce(2)


def _draw_areas(draw: ImageDraw.ImageDraw, view: View, patches: Sequence[Area]) -> None:
    """Patches, each with an edge around the union of its pieces."""
    for area in patches:
        pieces = [drawing.to_pixels(view, piece).ravel().tolist() for piece in area.pieces]
        for piece in pieces:  # a line reaches to both sides, a polygon's own outline only inwards
            draw.line([*piece, *piece[:4]], fill=area.edge, width=3 * FINE, joint="curve")
        for piece in pieces:
            draw.polygon(piece, fill=area.colour)


def load_font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib ships."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), max(size, 8))
