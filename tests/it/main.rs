//! Tests of the library and of the program on whole projects, one module for each promise.
//! `tests/slow/` has those that take longer.

mod attacks;
mod bombs;
mod cache;
mod cells;
mod confidence;
mod daemon_loop;
mod export;
mod floors;
mod ground;
mod one_door;
mod output;
mod pilot;
mod plan;
mod readers;
mod readers_foreign;
mod readers_hostile;
mod readme;
mod region;
mod replan;
mod round_trips;
mod schema;
mod splats;
mod train;
mod twins;
mod valley;
mod windows;
