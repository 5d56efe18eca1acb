//! `report.html`: the plan on one self-contained page, to inspect before it is used.
//!
//! Everything on the page follows a slider for the cut, so the page holds the whole ranking and how
//! each triangle's fulfilment grows along it (`history.rs`), on a surface that is made coarser
//! where it would be too large (`shown.rs`); arrays travel as base64 of little-endian numbers. The
//! files of `page/` draw it.

mod contents;
mod flight;
mod history;
mod holes;
mod listed_holes;
mod missed_region;
mod ranking;
mod real;
mod shown;
mod subject;
mod thumbnails;

use base64::{Engine, prelude::BASE64_STANDARD};
use bytemuck::NoUninit;

use crate::base::printable::json_escaped;

pub use contents::{Contents, ReportError};
pub use flight::MOST as MOST_PLANNED;
pub use holes::{Hole, Holes, holes};
pub use missed_region::MissedRegion;
pub use real::{DepthMapFolders, own_folder_of_maps};

const PAGE: &str = include_str!("page/page.html");
const STYLE: &str = include_str!("page/page.css");
/// The scripts, concatenated in the order of their dependencies.
const SCRIPT: &str = concat!(
    include_str!("page/data.js"),
    include_str!("page/surface.js"),
    include_str!("page/scene.js"),
    include_str!("page/curve.js"),
    include_str!("page/list.js"),
    include_str!("page/why.js"),
    include_str!("page/main.js"),
);

/// Returns the whole page.
pub fn page(contents: &Contents) -> String {
    // "</" would end the script element; JSON allows "<" to be escaped anywhere.
    let data = serde_json::to_string(contents).expect("string keys and finite numbers are JSON");
    let data = json_escaped(&data).replace('<', "\\u003c");
    let mut page = String::with_capacity(PAGE.len() + STYLE.len() + SCRIPT.len() + data.len());
    let mut rest = PAGE;
    for (mark, text) in [
        ("/*STYLE*/", STYLE),
        ("/*DATA*/", &data),
        ("/*SCRIPT*/", SCRIPT),
    ] {
        let (before, after) = rest
            .split_once(mark)
            .expect("page.html has its marks in this order");
        page += before;
        page += text;
        rest = after;
    }
    page + rest
}

/// Returns the little-endian bytes of the numbers in base64.
fn bytes<T: NoUninit>(values: &[T]) -> String {
    const {
        assert!(
            cfg!(target_endian = "little"),
            "the page reads little-endian numbers"
        )
    }
    BASE64_STANDARD.encode(bytemuck::cast_slice(values))
}
