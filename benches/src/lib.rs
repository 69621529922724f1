//! raygrad's benches.
