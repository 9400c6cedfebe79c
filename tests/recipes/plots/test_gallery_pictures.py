"""A picture of domains."""

import numpy as np
import torch
from PIL import Image

from ls3_recipes.commands.gallery import main
from ls3_recipes.plots.gallery import COLUMNS, example, moments


def test_moments_end_shortly_after_what_happens():
    flags = torch.arange(50)[:, None] >= 20
    chosen = moments(flags).tolist()
    assert len(chosen) == COLUMNS
    assert (chosen[0], chosen[-1]) == (0, 23)
    assert moments(torch.arange(50)[:, None] >= 49)[-1] == 49


def test_a_domain_whose_observation_has_no_colour_is_shown_in_colour():
    episode = example("cable_routing", "success")
    assert episode["next", "success"].any()
    observed, shown = episode["next", "pixels"][0], episode["next", "colour"][0]
    assert torch.equal(observed[0], observed[1])
    assert not torch.equal(shown[0], shown[1])


def test_the_gallery_is_drawn(tmp_path, capsys):
    main([str(tmp_path / "domains.png"), "--domains", "navigation"])
    assert "domains.png" in capsys.readouterr().out.replace("\n", "")
    pixels = np.asarray(Image.open(tmp_path / "domains.png").convert("RGB"))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20
