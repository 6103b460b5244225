"""Maps of located recordings in a results folder, from which heat maps are drawn later."""

from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.state import read_tensors
from avmsf.errors import EvaluationError
from avmsf.localization.contact_map import ContactMap

_KEY = "avmsf-contact-map"


def write_map(path: Path, found: ContactMap, *, truth: Float[Tensor, " 3"]) -> None:
    """Write a map, and the true contact (meters). Raises EvaluationError where that cannot be."""
    tensors = {"points": found.points, "distance": found.distance, "probability": found.probability, "truth": truth}
    energies = torch.tensor([found.explained_energy, found.modal_energy, found.null_energy], dtype=torch.float64)
    content = save({name: each.contiguous() for name, each in {**tensors, "energies": energies}.items()}, {_KEY: "1"})
    write_whole(path, lambda place: place.write_bytes(content), raising=EvaluationError)


def read_map(path: Path) -> tuple[ContactMap, Float[Tensor, " 3"]]:
    """Return a map that `write_map` wrote, and the true contact. Raises EvaluationError where there is none."""
    advice = "delete the object's file to compute it again"
    _, tensors = read_tensors(path, _KEY, what="the map of a contact", advice=advice, raising=EvaluationError)
    try:
        truth, energies = tensors.pop("truth"), tensors.pop("energies").tolist()
        return ContactMap(tensors["points"], tensors["distance"], tensors["probability"], *energies), truth
    except (KeyError, TypeError) as error:
        raise EvaluationError.expected("the map of a contact", got=str(error), file=path, advice=advice) from error
