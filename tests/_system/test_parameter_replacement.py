"""A module that computes with other parameters for a while."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from ssa_nerfstudio._system.parameter_replacement import parameters_replaced


def test_a_module_computes_with_other_parameters_where_one_is_shared_and_one_is_none():
    first, last = nn.Linear(2, 2, bias=False), nn.Linear(2, 2)
    last.weight = first.weight
    module, value = nn.Sequential(first, last), torch.tensor([[1.0, 2.0]])
    before = module(value)
    with parameters_replaced(module, [2 * torch.eye(2), torch.tensor([1.0, 0.0])]):
        assert module(value).tolist() == [[5.0, 8.0]]
    assert torch.equal(module(value), before)
    assert last.weight is first.weight
    assert [name for name, _ in module.named_parameters()] == ["0.weight", "1.bias"]
    with pytest.raises(ValueError, match="zip"), parameters_replaced(module, [torch.eye(2)]):
        pass
