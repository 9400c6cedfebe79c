"""Which device a run takes."""

import pytest
import torch

from ls3_recipes.device import choose_device, hardware


@pytest.fixture
def precision():
    """What products of float32 matrices are computed in, put back afterwards."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    yield torch.get_float32_matmul_precision
    torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_cuda_is_taken_where_it_is_with_tf32_products(monkeypatch, precision, name):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert choose_device(name) == torch.device("cuda")
    assert precision() == "high"


@pytest.mark.parametrize("name", ["auto", "cpu"])
def test_the_cpu_keeps_its_precision(monkeypatch, precision, name):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device(name) == torch.device("cpu")
    assert precision() == "highest"


def test_cuda_without_a_device_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"device=cuda was asked for, but .*no CUDA device\. Use device=cpu"):
        choose_device("cuda")


def test_the_hardware_is_described():
    found = hardware(torch.device("cpu"))
    assert set(found) == {"cpu", "cores", "threads", "gpu"}
    assert found["threads"] == torch.get_num_threads()
    assert found["gpu"] == "none"
