import pytest
import torch

from drgs.maths.unique_rows import unique_rows


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64, torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "columns"), [(500, 3), (500, 1), (1, 4), (0, 2)])
def test_rows_and_numbers_are_those_that_torch_finds(dtype: torch.dtype, count: int, columns: int) -> None:
    rows = torch.randint(-3, 4, (count, columns), generator=torch.Generator().manual_seed(count)).to(dtype)
    unique, number = unique_rows(rows)
    if count:
        expected, expected_number = torch.unique(rows, dim=0, return_inverse=True)
        assert torch.equal(unique, expected) and torch.equal(number, expected_number)
    assert torch.equal(unique[number], rows) and unique.dtype == dtype and len(number) == count


def test_places_that_differ_in_the_last_bit_are_not_one() -> None:
    place = torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]], dtype=torch.float64)
    place[1, 1] = torch.nextafter(place[1, 1], torch.tensor(3.0, dtype=torch.float64))
    assert unique_rows(place)[1].tolist() == [0, 1, 0]
