//! raygrad's tests.
