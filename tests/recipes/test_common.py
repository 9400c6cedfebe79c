"""Which device a run takes."""

import pytest
import torch

from common import choose_device


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
