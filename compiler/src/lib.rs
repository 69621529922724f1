//! raygrad's compiler: record, differentiate, simplify, fuse, plan.
pub mod scalar;
