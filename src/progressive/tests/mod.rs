//! Records and files against a reference that collapses edges on plain lists, and edits against
//! `EditMesh`.

mod branches;
mod damage;
mod edits;
mod reference;
mod round_trip;
mod size;
