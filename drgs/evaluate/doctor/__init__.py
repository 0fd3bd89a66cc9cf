"""Check a capture before time is spent on it. doctor.py asks; cameras.py, pictures.py, masks.py, places.py and light.py look at one side of a capture each;
photographs.py at plain pictures that have no cameras yet; findings.py is what they say.
"""

from drgs.evaluate.doctor.doctor import doctor

__all__ = ["doctor"]
