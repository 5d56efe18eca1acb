//! What is done with plans and projects beside planning.

pub mod dispatch;
pub mod doctor;
pub mod evaluate;
pub mod learn;
pub mod replan;
pub mod report;
pub mod undistort;
