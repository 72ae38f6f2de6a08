//! How many bytes a record takes.
