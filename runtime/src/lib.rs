//! raygrad's runtime.
