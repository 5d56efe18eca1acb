//! The tasks of an export: `run.json`, and how dmrecon and scene2pset compute what it lists.
//!
//! dmrecon ends with 0 for an empty map, and writes into the view's folder. So each map is made in
//! a scene of its own, of links to the views of its cluster, and moved to its place if it is whole.
//! A cloud is made in such a scene too, with links to the finished maps.

use std::{ffi::OsString, path::Path};

use serde::{Deserialize, Serialize};

use super::CLOUDS;
use crate::{
    backends::{
        Call, Product,
        runner::{is_not_empty, program_beside, refuse_unfit, text},
    },
    io::{
        depthmaps::{DepthMapFormat, mve},
        output::{self, FileSet},
        ply,
    },
    model::cluster::MapScale,
};

pub const RUN: &str = "run.json";
/// Ids up to this one may be of any number of views (`scene.cc`).
const MOST_IDS: usize = 5000;
/// Where dmrecon looks for the features that views share.
const BUNDLE: &str = "synth_0.out";

/// Content of `run.json`.
#[derive(Serialize, Deserialize)]
pub struct Run {
    /// Folders of all views.
    pub views: Vec<String>,
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
    /// Paths of the pictures of key view and partners, each beside its `meta.ini`.
    pub pictures: Vec<String>,
    pub bundle: String,
    pub scale: MapScale,
    /// Number of times that the images are halved.
    pub level: u32,
    /// Options of dmrecon.
    pub options: Vec<String>,
    /// Width and height of the map, pixels.
    pub size: [u32; 2],
}

/// Path of the depth map of a view.
pub fn map_of(view: &str, level: u32) -> String {
    format!("{view}/depth-L{level}.mvei")
}

impl Row {
    /// Its rank, and the content of the mark of its map.
    fn task(&self) -> (usize, &str) {
        (self.rank, &self.id)
    }

    /// Path of the depth map.
    pub fn map(&self) -> String {
        map_of(&self.view, self.level)
    }

    /// Path of the picture at the size of the map, which scene2pset takes colours from; `None` at
    /// full size.
    fn reduced_picture(&self) -> Option<String> {
        (self.level > 0).then(|| format!("{}/undist-L{}.png", self.view, self.level))
    }

    /// Files that dmrecon writes for the view. The depth map comes last: once it is in place, all
    /// is.
    fn made(&self) -> impl Iterator<Item = String> {
        self.reduced_picture().into_iter().chain([self.map()])
    }
}

impl Run {
    fn finished(&self, call: &Call) -> impl Iterator<Item = &Row> {
        self.maps.iter().filter(|row| call.is_finished(row.rank))
    }

    /// The clouds of the finished maps, with the level of their maps.
    fn clouds(&self, call: &Call) -> Vec<(&'static str, u32)> {
        let level = |scale| self.finished(call).find(|row| row.scale == scale);
        let clouds = CLOUDS.into_iter();
        clouds
            .filter_map(|(scale, cloud)| Some((cloud, level(scale)?.level)))
            .collect()
    }

    /// Adds pictures with their views. MVE refuses ids that are large for the number of views.
    fn add_views<'a>(
        &self,
        pictures: impl Iterator<Item = &'a String>,
        call: &Call,
        files: &mut FileSet,
    ) {
        let mut add = |path: String| files.add(&*path, call.link(&path));
        for picture in pictures {
            let folder = picture.rsplit_once('/').map_or("", |(folder, _)| folder);
            add(format!("{folder}/meta.ini"));
            add(picture.clone());
        }
        if self.views.len() > MOST_IDS {
            let views = self.views.iter();
            views.for_each(|view| add(format!("{view}/meta.ini")));
        }
    }
}

/// Makes the scene of a task, and returns the commands that do it there.
pub fn commands(call: &Call) -> Result<Vec<Vec<OsString>>, String> {
    let run: Run = call.read(RUN)?;
    let mut files = FileSet::new(call.work, "scene");
    let commands = match call.product {
        Product::Map(rank) => {
            let row = call.row_of(rank, &run.maps, Row::task)?;
            run.add_views(row.pictures.iter(), call, &mut files);
            files.add(BUNDLE, call.link(&row.bundle));
            vec![command(call.program, &row.options, &[call.work])]
        }
        Product::Cloud => {
            for row in run.finished(call) {
                run.add_views(row.pictures.iter().take(1), call, &mut files);
                for path in row.made() {
                    files.add(&*path, call.made(&path)?);
                }
            }
            let joining = program_beside(call.program, "scene2pset")?;
            // Without `-v`: the scene has no views but those of finished maps.
            let join = |(cloud, level)| {
                let made = call.work.join(cloud);
                command(&joining, &[format!("-F{level}")], &[call.work, &made])
            };
            run.clouds(call).into_iter().map(join).collect()
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

/// Options of scene2pset for the maps of these ranks, in a scene of more.
pub fn joined(ranks: impl Iterator<Item = usize>, level: u32) -> [String; 2] {
    let ids: Vec<String> = ranks.map(|rank| (rank - 1).to_string()).collect();
    // Without `-v`, scene2pset takes all views.
    [format!("-F{level}"), format!("-v{}", ids.join(","))]
}

/// Checks what the programs have made, and puts it in its place.
pub fn finish(call: &Call) -> Result<(), String> {
    match call.product {
        Product::Map(rank) => {
            let run: Run = call.read(RUN)?;
            let row = call.row_of(rank, &run.maps, Row::task)?;
            refuse_unfit(&call.work.join(row.map()), DepthMapFormat::Mve, row.size)?;
            row.made().try_for_each(|path| call.place(&path))
        }
        Product::Cloud => {
            let run: Run = call.read(RUN)?;
            let made = run.clouds(call);
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
                    // It would be mistaken for part of the new result.
                    output::remove(&call.workplace.join(cloud), &call.disk()).map_err(text)?;
                }
            }
            Ok(())
        }
    }
}

/// Returns whether a depth map is all there, with the picture that it has its colours from.
pub fn is_whole(map: &Path) -> bool {
    let name = map.file_name().and_then(|name| name.to_str());
    let level = name.and_then(|name| name.strip_prefix("depth-L")?.strip_suffix(".mvei"));
    let has_picture =
        |level| level == "0" || is_not_empty(&map.with_file_name(format!("undist-L{level}.png")));
    mve::whole_size(map).is_ok() && level.is_some_and(has_picture)
}
