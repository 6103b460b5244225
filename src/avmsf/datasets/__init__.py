"""Published recordings of many objects, each read as the `Capture` that a folder made by hand would give.

`open_dataset` takes a folder, recognizes by its files' names what it holds (`detect`), and returns a `Dataset`, which
lists its `objects`, says what is known of each (`facts`), what shows it (`visual_source`) and what is missing
(`check`), and reads one at a time (`capture`):

- `objectfolder.ObjectFolderRaw`: ObjectFolder Real (Gao et al., CVPR 2023) as it is published, a folder a contact, with
  the microphone's sound, the hammer's force and two notes; contacts by SonicGauss's lists.
- `realimpact.RealImpact`: RealImpact (Clarke et al., CVPR 2023), sounds that are divided by the hammer's spectrum
  already, by 600 microphones, of which the closest common one is taken.
- `collection.CaptureCollection`: capture folders side by side, those of `avmsf simulate` among them.

Recordings pass through `recordings.build_capture`, which prepares them as `avmsf.capture` does a user's and leaves out
what cannot be used, with a warning. Both published datasets count objects by the same numbers and share many:
`numbering` has their names, and says which must not be in the training and the test set at once. Units are meters,
hertz and newtons.

Start reading with `dataset.Dataset`, then `collection.open_dataset`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
