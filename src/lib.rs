//! viewrank ranks multi-view stereo view clusters before any depth map is computed.
//!
//! The map, in the order of the flow:
//!
//! - [`formats`] bytes of sparse models <-> [`scene::Scene`]; [`camera`] the camera models
//! - [`project`] what kind of project is this folder; [`georeference`] where on the earth it lies
//! - [`tiles`] space cut into parts; [`surface`] method 1: the surface; [`visibility`] method 2: which view sees which triangle
//! - [`confidence`] method 7: where will the backend succeed
//! - [`fulfilment`] method 3; [`partners`] method 4; [`ranking`] method 5
//! - [`backends`] what each MVS program can match and the files it reads
//! - [`undistort`] undistorted images for the backends that need them
//! - [`depthmaps`] finished depth maps of the backends
//! - [`pictures`] and [`report`] what people look at; [`tables`] what programs check; [`dispatch`] the clusters as tasks of a queue
//! - [`plan`] runs the stages; [`evaluate`] method 8: real fulfilment, baselines; [`replan`] method 5.4; [`output`] makes files appear whole or not at all
//! - [`doctor`] what is wrong with a project before it is planned
//! - [`config`] every setting; [`progress`] progress and cancellation; [`error`] what errors say beside their message; [`shell`] commands to type
//! - [`column`] columns of large tables, in memory or on disk; [`input`] opens what a project names; `connected` parts of a graph; `vector` inner loops for the processor at hand; `large_pages` for lists that are read all over

pub mod backends;
pub mod camera;
pub mod column;
pub mod confidence;
pub mod config;
mod connected;
pub mod daemon;
pub mod depthmaps;
pub mod dispatch;
pub mod doctor;
pub mod error;
pub mod evaluate;
pub mod formats;
pub mod fulfilment;
pub mod georeference;
pub mod input;
mod large_pages;
pub mod manifest;
pub mod output;
pub mod partners;
pub mod pictures;
pub mod plan;
pub mod progress;
pub mod project;
pub mod ranking;
pub mod replan;
pub mod report;
pub mod scene;
pub mod shell;
pub mod surface;
pub mod synthetic;
pub mod tables;
pub mod tiles;
pub mod undistort;
mod vector;
pub mod visibility;
