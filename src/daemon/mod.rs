//! `viewrank watch`: plans each project when its sparse model is complete, and follows the backend.
//!
//! [`discover`] finds projects, [`watch`] hints at changes, [`settle`] says whether the input is still and new, [`state`] is what is
//! known of a project.

pub mod discover;
pub mod settle;
pub mod state;
pub mod watch;
