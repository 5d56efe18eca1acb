//! The tasks of an export: `run.json`, and how AliceVision computes and joins what it lists.
//!
//! A map is made in a folder of its own. Filtering takes counts that it finds in its output folder
//! for its own, and opens the maps of all views of its scene: it gets an empty folder, and a scene
//! of the key views that have a map.

use std::{collections::BTreeSet, ffi::OsString, fs, path::Path};

use serde::{Deserialize, Serialize};

use super::sfm;
use crate::{
    backends::{
        Call, Product,
        runner::{program_beside, refuse_unfit, text, words},
    },
    io::{
        depthmaps::DepthMapFormat,
        output::{Contents, FileSet},
    },
};

pub const RUN: &str = "run.json";
/// Scene of all key views.
pub const KEYS: &str = "keys.sfm";
/// Only key views have maps, and three of them rarely agree.
pub const FILTERING: [&str; 4] = [
    "--minNumOfConsistentCams",
    "1",
    "--minNumOfConsistentCamsWithLowSimilarity",
    "2",
];
/// Folder of the depth maps.
pub const MAPS: &str = "depthMaps";
/// Results of the meshing.
const MESH: &str = "mesh.obj";
const CLOUD: &str = "dense.abc";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    /// The view clusters in rank order.
    pub maps: Vec<Row>,
}

/// The depth map of a view cluster.
#[derive(Serialize, Deserialize)]
pub struct Row {
    /// From 1.
    pub rank: usize,
    /// Content of its mark.
    pub id: String,
    /// Id of the key view's image.
    pub view: u32,
    /// Path of the scene file of the cluster.
    pub scene: String,
    /// Options of aliceVision_depthMapEstimation.
    pub options: Vec<String>,
    /// Width and height of the map, pixels.
    pub size: [u32; 2],
}

/// Path of the depth map of an image.
pub fn map_of(image_id: u32) -> String {
    format!("{MAPS}/{image_id}_depthMap.exr")
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.id)
    }

    /// Path of the depth map.
    pub fn map(&self) -> String {
        map_of(self.view)
    }

    /// Returns what was made for the view below a folder; the depth map comes last: once it is in
    /// place, all is.
    fn made(&self, folder: &Path) -> Vec<String> {
        // With the underscore: view 1 must not take the files of view 10.
        let of_view = format!("{}_", self.view);
        let entries = fs::read_dir(folder.join(MAPS)).into_iter().flatten();
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let map = self.map();
        let others = names
            .filter(|name| name.starts_with(&of_view) && name.ends_with(".exr"))
            .map(|name| format!("{MAPS}/{name}"))
            .filter(|path| *path != map);
        let mut paths: Vec<String> = others.collect();
        // A folder lists its files in an order of its own.
        paths.sort();
        paths.push(map);
        paths
    }
}

/// Makes the folder of a task, and returns the commands that do it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    let mut files = FileSet::new(call.work, "task");
    let commands = match call.product {
        Product::Map(rank) => {
            let row = call.row_of(rank, &run.maps, Row::task)?;
            files.add(MAPS, Contents::Folder);
            let [scene, images] = [&*row.scene, "images"].map(|name| call.workplace.join(name));
            let made = call.work.join(MAPS);
            let mut command = words([
                &call.program,
                &"-i",
                &scene,
                &"--imagesFolder",
                &images,
                &"-o",
                &made,
            ]);
            command.extend(row.options.iter().map(OsString::from));
            vec![command]
        }
        Product::Cloud => {
            let rows = run.maps.iter().filter(|row| call.is_finished(row.rank));
            lay_out_joining(&rows.collect::<Vec<_>>(), call, &mut files)?;
            joining(call)?
        }
    };
    files.write(&call.disk()).map_err(text)?;
    Ok(commands)
}

/// Adds the maps, and the scene of the views that have one, beside their images.
fn lay_out_joining(rows: &[&Row], call: &Call, files: &mut FileSet) -> Result<(), String> {
    for path in rows.iter().flat_map(|row| row.made(call.workplace)) {
        files.add(&*path, call.made(&path)?);
    }
    let images = fs::read_dir(call.workplace.join("images")).map_err(text)?;
    for name in images.filter_map(|entry| entry.ok()?.file_name().into_string().ok()) {
        let path = format!("images/{name}");
        files.add(&*path, call.link(&path));
    }
    let views: BTreeSet<String> = rows.iter().map(|row| row.view.to_string()).collect();
    let scene = sfm::with_views(call.list(KEYS)?, |id| views.contains(id));
    files.add_text(KEYS, scene.map_err(text)?);
    files.add("filtered", Contents::Folder);
    Ok(())
}

fn joining(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let [filter, mesh] = ["aliceVision_depthMapFiltering", "aliceVision_meshing"]
        .map(|name| program_beside(call.program, name));
    let [scene, maps, filtered, cloud, surface] =
        [KEYS, MAPS, "filtered", CLOUD, MESH].map(|name| call.work.join(name));
    let mut filtering = words([
        &filter?,
        &"-i",
        &scene,
        &"--depthMapsFolder",
        &maps,
        &"-o",
        &filtered,
    ]);
    filtering.extend(FILTERING.map(OsString::from));
    let meshing = words([
        &mesh?,
        &"-i",
        &scene,
        &"--depthMapsFolder",
        &filtered,
        // `-o` is short for two options here.
        &"--output",
        &cloud,
        &"--outputMesh",
        &surface,
    ]);
    Ok(vec![filtering, meshing])
}

/// Checks what the programs have made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.maps, Row::task)?;
            let (map, format) = (call.work.join(row.map()), DepthMapFormat::AliceVision);
            refuse_unfit(&map, format, row.size)?;
            let made = row.made(call.work);
            made.iter().try_for_each(|path| call.place(path))
        }
        Product::Cloud => {
            // Both before either is moved: a mesh and a cloud of two runs would be taken for one
            // result.
            for name in [MESH, CLOUD] {
                if fs::metadata(call.work.join(name)).map_or(0, |made| made.len()) == 0 {
                    return Err(format!("the meshing made no {name}"));
                }
            }
            call.place(MESH)?;
            // The cloud goes last, since it says that the maps are joined.
            call.place(CLOUD)
        }
    }
}
