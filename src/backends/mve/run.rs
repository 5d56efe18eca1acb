//! The tasks of an export: `run.json`, and how dmrecon and scene2pset compute what it lists.
//!
//! dmrecon ends with 0 for an empty map, passes over views that have one, and writes into the
//! view's folder. So each map is made in a scene of its own, of links to the views, and moved to
//! its place if it is whole. A cloud is made in such a scene too, with links to the finished maps.

use std::{collections::BTreeSet, ffi::OsString, fs, path::Path};

use serde::{Deserialize, Serialize};

use super::CLOUDS;
use crate::{
    backends::{
        Call, Product,
        runner::{program_beside, refuse_unfit, text},
    },
    io::{
        depthmaps::{DepthMapFormat, mve},
        output::{self, FileSet},
        ply,
    },
    model::cluster::MapScale,
};

pub const RUN: &str = "run.json";
/// Where dmrecon looks for the features that views share.
const BUNDLE: &str = "synth_0.out";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    /// Paths of the pictures of all views, each beside its `meta.ini`.
    pub pictures: Vec<String>,
    /// The view clusters in rank order.
    pub maps: Vec<Row>,
}

/// The depth map of a view cluster.
#[derive(Serialize, Deserialize)]
pub struct Row {
    /// From 1; MVE's id of the key view counts from 0.
    pub rank: usize,
    /// Content of its mark.
    pub id: String,
    /// Folder of the key view.
    pub view: String,
    pub bundle: String,
    pub scale: MapScale,
    /// Number of times that the images are halved.
    pub level: u32,
    /// Options of dmrecon.
    pub options: Vec<String>,
    /// Width and height of the map, pixels.
    pub size: [u32; 2],
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.id)
    }

    /// Path of the depth map.
    pub fn map(&self) -> String {
        format!("{}/depth-L{}.mvei", self.view, self.level)
    }

    /// Returns what dmrecon has written for the view below a folder; the depth map is last, since
    /// it says that all is there.
    fn made(&self, folder: &Path) -> Vec<String> {
        let level = format!("-L{}.", self.level);
        let entries = fs::read_dir(folder.join(&self.view)).into_iter().flatten();
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let map = self.map();
        let others = names
            .filter(|name| name.contains(&level))
            .map(|name| format!("{}/{name}", self.view))
            .filter(|path| *path != map);
        let mut paths: Vec<String> = others.collect();
        paths.sort();
        paths.push(map);
        paths
    }
}

impl Run {
    /// Rows of the finished maps of each size that has any, with the name of their cloud.
    fn finished(&self, call: &Call) -> Vec<(&'static str, Vec<&Row>)> {
        let ranks: BTreeSet<usize> = call.finished.iter().copied().collect();
        let rows_of = |(scale, cloud): (MapScale, &'static str)| {
            let is_it = |row: &&Row| row.scale == scale && ranks.contains(&row.rank);
            (cloud, self.maps.iter().filter(is_it).collect::<Vec<_>>())
        };
        let sizes = CLOUDS.into_iter().map(rows_of);
        sizes.filter(|(_, rows)| !rows.is_empty()).collect()
    }
}

/// Makes the scene of a task, and returns the commands that do it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    let mut files = FileSet::new(call.work, "scene");
    // All views: MVE refuses ids that are large for their number.
    for picture in &run.pictures {
        let folder = picture.rsplit_once('/').map_or("", |(folder, _)| folder);
        for path in [picture.clone(), format!("{folder}/meta.ini")] {
            files.add(&*path, call.link(&path));
        }
    }
    let commands = match call.product {
        Product::Map(rank) => {
            let row = call.row_of(rank, &run.maps, Row::task)?;
            files.add(BUNDLE, call.link(&row.bundle));
            vec![command(call.program, &row.options, &[call.work])]
        }
        Product::Cloud => {
            let clouds = run.finished(call);
            for row in clouds.iter().flat_map(|(_, rows)| rows) {
                for path in row.made(call.workplace) {
                    files.add(&*path, call.link(&path));
                }
            }
            let joining = program_beside(call.program, "scene2pset")?;
            let join = |(cloud, rows): &(&str, Vec<&Row>)| {
                let made = call.work.join(cloud);
                let options = joined(rows.iter().map(|row| row.rank), rows[0].level);
                command(&joining, &options, &[call.work, &made])
            };
            clouds.iter().map(join).collect()
        }
    };
    files.write(&call.disk()).map_err(text)?;
    Ok(commands)
}

fn command(program: &Path, options: &[String], paths: &[&Path]) -> Vec<OsString> {
    let options = options.iter().map(OsString::from);
    [program.into()]
        .into_iter()
        .chain(options)
        .chain(paths.iter().map(OsString::from))
        .collect()
}

/// Options of scene2pset for the maps of these ranks. Without any it would take all views.
pub fn joined(ranks: impl Iterator<Item = usize>, level: u32) -> [String; 2] {
    let ids: Vec<String> = ranks.map(|rank| (rank - 1).to_string()).collect();
    [format!("-F{level}"), format!("-v{}", ids.join(","))]
}

/// Checks what the programs have made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.maps, Row::task)?;
            refuse_unfit(&call.work.join(row.map()), DepthMapFormat::Mve, row.size)?;
            let made = row.made(call.work);
            made.iter().try_for_each(|path| call.place(path))
        }
        Product::Cloud => {
            let run: Run = call.read(RUN)?;
            let made = run.finished(call);
            for (cloud, _) in &made {
                let points = ply::counts(&call.work.join(cloud)).map_or(0, |[points, _]| points);
                if points == 0 {
                    return Err("scene2pset joined no points".into());
                }
            }
            for (_, cloud) in CLOUDS {
                if made.iter().any(|(made, _)| *made == cloud) {
                    call.place(cloud)?;
                } else {
                    // One of another plan would stand beside the new one.
                    output::remove(&call.workplace.join(cloud), &call.disk()).map_err(text)?;
                }
            }
            Ok(())
        }
    }
}

/// Returns whether a depth map is all there.
pub fn is_whole(map: &Path) -> bool {
    mve::whole_size(map).is_ok()
}
