//! Records and files against a reference that collapses edges on plain lists.

mod damage;
mod reference;
mod round_trip;
mod size;
