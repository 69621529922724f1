//! Derived operations: plain functions of ops, with no rules of their own.
pub mod matrix;
