"""What gain fields of tests lack that only predict: an uncertainty, and a form in a file."""

import torch


class Unsaved:
    """A gain field that knows no doubt and is never kept in a file."""

    def point_estimate(self, contacts: torch.Tensor, directions: torch.Tensor | None = None):
        return self.at(contacts, directions)

    def deviation(self, contacts: torch.Tensor, directions: torch.Tensor | None = None) -> None:
        return None

    def record(self):
        raise NotImplementedError

    def tensors(self):
        raise NotImplementedError

    @classmethod
    def skeleton(cls, record):
        raise NotImplementedError

    @classmethod
    def restore(cls, record, tensors):
        raise NotImplementedError
