"""Named physical numbers: vector <-> names, priors, and the code that writes them into a model."""

from bayessim_mjx.parameters.constants import set_const
from bayessim_mjx.parameters.parameter import Parameter
from bayessim_mjx.parameters.space import ParameterSpace

__all__ = ["Parameter", "ParameterSpace", "set_const"]
