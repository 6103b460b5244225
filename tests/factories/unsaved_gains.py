"""What gain fields of tests lack that only predict: an uncertainty, and a form in a file."""

from avmsf.field.gains.model import GainModel


class Unsaved(GainModel):
    """A gain field without a posterior that is never kept in a file."""

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
