//! Uses of plans and projects: everything but planning itself.

pub mod dispatch;
pub mod doctor;
pub mod evaluate;
pub mod learn;
pub mod replan;
pub mod report;
pub mod undistort;
