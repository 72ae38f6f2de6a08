//! progressive
