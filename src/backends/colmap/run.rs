//! The tasks of an export: `run.json`, and how COLMAP computes and fuses what it lists.
//!
//! COLMAP keeps a map that exists, whatever it was made from, and writes in place. So each map is
//! made in a workspace of its own, of links to the model and its pictures, and moved to its place
//! if it is whole. The cloud is fused in such a workspace, too, from the maps that are finished.

use std::{ffi::OsString, path::Path, slice};

use serde::{Deserialize, Serialize};

use super::{
    FUSED, MAIN_LIST, PHOTOMETRIC, as_path,
    cfg::{self, Problem},
    fusion_options, map_folders,
    marks::map_name,
};
use crate::{
    backends::{
        Call, Product,
        runner::{refuse_other_shape, text},
    },
    io::{
        depthmaps::colmap::whole_size,
        output::{Contents, FileSet},
        ply,
    },
};

pub const RUN: &str = "stereo/viewrank/run.json";
/// Files of a model, without suffix.
const MODEL: [&str; 5] = ["cameras", "images", "points3D", "rigs", "frames"];
/// Folders of what COLMAP makes of a view, with its number of channels and its name. The depth map
/// is moved last, since it says that all is there.
const KINDS: [(&str, u32, &str); 2] = [
    ("normal_maps", 3, "normal map"),
    ("depth_maps", 1, "depth map"),
];

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    /// Number of images of the model.
    pub images: usize,
    pub maps: Vec<Row>,
}

/// The depth map of a view cluster.
#[derive(Serialize, Deserialize)]
pub struct Row {
    pub rank: usize,
    /// Content of its mark.
    pub id: String,
    /// That of a map of full size, which does for one of half the size.
    #[serde(default)]
    pub id_at_full_size: String,
    pub problem: Problem,
    /// Long side to which the images are reduced, pixels.
    pub max_image_size: Option<u32>,
    /// Width and height of the map, pixels.
    pub size: [u32; 2],
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.id)
    }

    fn path(&self, folder: &str) -> String {
        let name = map_name(&self.problem.reference, "photometric");
        format!("stereo/{folder}/{name}")
    }
}

/// Lays out the workspace of a task, and returns the command that does it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    let mut files = FileSet::new(call.work, "workspace");
    for name in MODEL
        .iter()
        .flat_map(|name| ["bin", "txt"].map(|end| format!("{name}.{end}")))
    {
        let path = format!("sparse/{name}");
        // A model is binary or text, and only those of COLMAP 3.12 and later have rigs and frames.
        if call.workplace.join(&path).is_file() {
            files.add(&*path, call.link(&path));
        }
    }
    let (verb, options) = match call.product {
        Product::Map(rank) => {
            lay_out_map(call.row_of(rank, &run.maps, Row::task)?, call, &mut files)
        }
        Product::Cloud => lay_out_fusion(&run, call, &mut files),
    };
    files.write(&call.disk()).map_err(text)?;
    let words = [
        call.program.as_os_str(),
        verb.as_ref(),
        "--workspace_path".as_ref(),
    ];
    let words = words.map(OsString::from).into_iter();
    let mut command: Vec<OsString> = words.chain([call.work.into()]).collect();
    command.extend(options.split(' ').map(OsString::from));
    if call.product == Product::Cloud {
        // Not among the options, which are split at blanks: a folder's name may have some.
        command.extend(["--output_path".into(), call.work.join(FUSED).into()]);
    }
    Ok(vec![command])
}

fn add_image(name: &str, call: &Call, files: &mut FileSet) {
    let path = format!("images/{}", as_path(name));
    files.add(&*path, call.link(&path));
}

fn lay_out_map(row: &Row, call: &Call, files: &mut FileSet) -> (&'static str, String) {
    for name in row.problem.names() {
        add_image(name, call, files);
    }
    let problems = slice::from_ref(&row.problem);
    files.add_text(MAIN_LIST, cfg::write_patch_match(&[], problems));
    for folder in map_folders(problems.iter()) {
        files.add(folder, Contents::Folder);
    }
    let size = row.max_image_size;
    let size = size.map(|side| format!(" --PatchMatchStereo.max_image_size {side}"));
    let options = PHOTOMETRIC.to_owned() + &size.unwrap_or_default();
    ("patch_match_stereo", options)
}

fn lay_out_fusion(run: &Run, call: &Call, files: &mut FileSet) -> (&'static str, String) {
    let is_there = |row: &&Row| call.is_finished(row.rank);
    let mut listed = String::new();
    for row in run.maps.iter().filter(is_there) {
        add_image(&row.problem.reference, call, files);
        for (folder, ..) in KINDS {
            files.add(row.path(folder), call.link(&row.path(folder)));
        }
        listed += &format!("{}\n", row.problem.reference);
    }
    let options = fusion_options("photometric", listed.lines().count(), run.images);
    files.add_text("stereo/fusion.cfg", listed);
    files.add("stereo/viewrank", Contents::Folder);
    ("stereo_fusion", options)
}

/// Checks what COLMAP has made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.maps, Row::task)?;
            // Both maps are checked before either is moved, so that a failure leaves the earlier
            // pair.
            for (folder, channels, what) in KINDS {
                check(&call.work.join(row.path(folder)), channels, what, row.size)?;
            }
            KINDS
                .iter()
                .try_for_each(|(folder, ..)| call.place(&row.path(folder)))
        }
        Product::Cloud => {
            let points = ply::counts(&call.work.join(FUSED)).map_or(0, |[points, _]| points);
            if points == 0 {
                return Err("COLMAP fused no points".into());
            }
            let views = format!("{FUSED}.vis");
            // Before the cloud, which says that the maps are fused.
            if call.work.join(&views).exists() {
                call.place(&views)?;
            }
            call.place(FUSED)
        }
    }
}

/// Fails unless a map is all there, and of the shape of this size.
fn check(path: &Path, channels: u32, what: &str, size: [u32; 2]) -> Result<(), String> {
    if !path.exists() {
        return Err(format!("COLMAP made no {what}"));
    }
    let made = whole_size(path, channels).map_err(text)?;
    refuse_other_shape(what, made, size)
}

/// Returns whether a depth map and its normal map are all there.
pub fn is_whole(depth_map: &Path) -> bool {
    let is_it = |above: &&Path| above.ends_with("stereo/depth_maps");
    // Names of images may have folders, so the map may be several levels below.
    let normal_map = depth_map.ancestors().find(is_it).and_then(|folder| {
        let name = depth_map.strip_prefix(folder).ok()?;
        Some(folder.with_file_name("normal_maps").join(name))
    });
    whole_size(depth_map, 1).is_ok() && normal_map.is_some_and(|map| whole_size(&map, 3).is_ok())
}
