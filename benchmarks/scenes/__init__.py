"""Rendered scenes with true boxes: football, and objects led away by a distracter. No command."""

from benchmarks.scenes.distracter import DistracterScene as DistracterScene
from benchmarks.scenes.distracter import NoPath as NoPath
from benchmarks.scenes.distracter import distracter_scene as distracter_scene
from benchmarks.scenes.football import Scene as Scene
from benchmarks.scenes.football import football_scene as football_scene
