"""Pictures: of a run's components, and the figures of the papers. Only here matplotlib is used."""

from mpfjax.plotting.components import draw_components as draw_components
from mpfjax.plotting.papers import COLOURS as COLOURS
from mpfjax.plotting.papers import MARKERS as MARKERS
from mpfjax.plotting.papers import CostPanel as CostPanel
from mpfjax.plotting.papers import ParticleHistory as ParticleHistory
from mpfjax.plotting.papers import draw_contact_sheet as draw_contact_sheet
from mpfjax.plotting.papers import draw_costs as draw_costs
from mpfjax.plotting.papers import draw_curves as draw_curves
from mpfjax.plotting.papers import draw_errors_by_size as draw_errors_by_size
from mpfjax.plotting.papers import draw_object_bars as draw_object_bars
from mpfjax.plotting.papers import draw_optimisations as draw_optimisations
from mpfjax.plotting.papers import draw_overlaps as draw_overlaps
from mpfjax.plotting.papers import draw_rates as draw_rates
from mpfjax.plotting.papers import draw_scores as draw_scores
from mpfjax.plotting.papers import draw_typical_run as draw_typical_run
from mpfjax.plotting.papers import standard_error as standard_error
