"""The rows of a table that differ, in order, as torch.unique(dim=0) and numpy.unique(axis=0) find them, which compare row by row.

A stable sort by each column from the last to the first leaves rows in the same order, in a small part of the time. NaN is not expected.
"""

import torch
from jaxtyping import Int, Shaped
from torch import Tensor


def unique_rows(rows: Shaped[Tensor, "row column"]) -> tuple[Shaped[Tensor, "unique column"], Int[Tensor, "row"]]:
    """Those that differ, sorted by their first column, where that is the same by their second, and so on; and of each row its number among them."""
    order = torch.arange(len(rows), device=rows.device)
    for column in reversed(rows.unbind(1)):
        order = order[column[order].argsort(stable=True)]
    ordered = rows[order]
    first = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    first[1:] = (ordered[1:] != ordered[:-1]).any(1)
    number = torch.empty_like(order)
    number[order] = first.long().cumsum(0) - 1
    return ordered[first], number
