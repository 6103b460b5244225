"""Parts of ObjectFolder Real that the paper takes for its smaller studies, by the numbers of the objects' folders."""

ABLATION = ("1", "11", "28", "38", "41", "44", "52", "57", "66", "75")
"""Objects of the ablations, of the few-shot, the sampling and the input-view studies (supplement, implementation
details)."""
NON_SYMMETRIC = (
    "1", "14", "17", "24", "39", "40", "41", "44", "45", "52", "54", "55", "57", "66", "79", "91",
)  # fmt: skip
"""Objects of the case study without symmetry and of contact localisation (the same place)."""
