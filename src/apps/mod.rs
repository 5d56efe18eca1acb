//! Uses of plans and projects, planning for a backend first.

pub mod dispatch;
pub mod doctor;
pub mod evaluate;
pub mod learn;
pub mod planning;
pub mod replan;
pub mod report;
pub mod undistort;
