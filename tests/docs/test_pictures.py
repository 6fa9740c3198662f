"""The pictures of the documentation stay small, and every scene and stage has one."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
IMAGES = sorted((ROOT / "docs" / "images").iterdir())
SIZES = {path.name: path.stat().st_size for path in IMAGES}


def test_pictures_are_small() -> None:
    assert sum(SIZES.values()) < 4_000_000
    assert SIZES["haze.webp"] < 1_500_000
    assert all(size < 180_000 for name, size in SIZES.items() if name.startswith(("gallery_", "stage_", "recipe_")))
    assert all(size < 600_000 for name, size in SIZES.items() if name.startswith("video_"))


def test_gallery_shows_every_scene_and_stage() -> None:
    text = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    made = {name for name in SIZES if name.startswith(("gallery_", "stage_"))}
    assert set(re.findall(r"\(images/(\w+\.webp)\)", text)) == made
    assert sum(name.startswith("gallery_") for name in made) == 9


def test_readme_opens_with_a_moving_picture_and_two_commands() -> None:
    opening = (ROOT / "README.md").read_text("utf-8").split("\n## ")[0]
    assert "(docs/images/haze.webp)" in opening
    commands = re.search(r"```bash\n(.*?)```", opening, re.DOTALL)[1].splitlines()
    assert [command.split()[0] for command in commands] == ["python3", "turbrestore"]
