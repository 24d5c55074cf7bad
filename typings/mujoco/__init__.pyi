# MuJoCo's bindings are compiled and come without types; this says that their names exist, and no more.
from typing import Any

def __getattr__(name: str) -> Any: ...
