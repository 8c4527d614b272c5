"""What is only the paper's (Bensa et al. 2005, IV): eq. 19 on its bands, its gradient, its annealing, its three steps.

`recipes` is the door; nothing here knows the default estimator.
"""

from .recipes import RECIPES, Found, check_recipe, claims, fit_by_paper

__all__ = ["RECIPES", "Found", "check_recipe", "claims", "fit_by_paper"]
