//! raygrad: differentiable rendering.
