//! Inputs of a fusion: the scene of the key views, the list of neighbours, and the finished maps,
//! all at one size.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use super::run::Run;
use crate::{
    backends::{Call, runner::text, selection::FUSED_WITH},
    io::{
        depthmaps::openmvs::WholeMap,
        formats::openmvs::{Mvs, NO_POSE},
        input::{self, FileKind},
        output::{self, Contents, FileSet},
        ply,
    },
};

/// Returns the list of neighbours of a fusion of all maps.
pub fn neighbours(overlaps: &[Vec<usize>]) -> String {
    let line = |(i, others): (usize, &Vec<usize>)| {
        let names = std::iter::once(&i).chain(others.iter().take(FUSED_WITH));
        let names: Vec<String> = names.map(usize::to_string).collect();
        names.join(" ") + "\n"
    };
    let keys = overlaps
        .iter()
        .enumerate()
        .filter(|(_, others)| !others.is_empty());
    keys.map(line).collect()
}

/// Puts a scene, lists and the finished maps where they are fused; returns how many must agree.
/// Maps larger than those of this image size are left out.
pub fn lay_out(run: &Run, call: &Call) -> Result<usize, String> {
    let mut files = FileSet::new(call.work, "fusion");
    let mut kinds: BTreeMap<&str, &str> = BTreeMap::new();
    let (mut there, mut small) = (BTreeSet::new(), Vec::new());
    for (i, row) in run.finished(call) {
        let path = call.workplace.join(&row.map);
        let map = WholeMap::read(&path, row.size).map_err(text)?;
        kinds.insert(map.kind(), &row.map);
        let full = size_at(row.size, run.resolution);
        if map.size()[0] > full[0] + 1 {
            continue;
        }
        if map.size() == full {
            files.add(&*row.map, call.link(&row.map));
        } else {
            small.push((row, map, full));
        }
        there.insert(i);
        files.add(&*row.image, call.link(&row.image));
    }
    refuse_two_kinds(&kinds)?;
    files.add("fuse.mvs", Contents::Bytes(scene_of(call, &there)?));
    files.add_text("fuse.txt", neighbours(&overlaps_among(run, &there)));
    files.write(&call.disk()).map_err(text)?;
    // Fusion takes the camera of its own image size for every map, whatever the size of the map.
    for (row, map, full) in small {
        let bytes = map.enlarged(full).map_err(text)?;
        output::replace(&call.work.join(&row.map), &bytes, &call.disk()).map_err(text)?;
    }
    // With a single map, no other can agree.
    Ok(run.maps_per_point.min(there.len()))
}

/// Fails unless a fusion has made a scene, and a cloud with points.
pub fn check(work: &Path) -> Result<(), String> {
    let counts = ply::counts(&work.join("fused.ply"));
    let has_points = counts.is_some_and(|[points, _]| points > 0);
    if has_points && work.join("fused.mvs").is_file() {
        Ok(())
    } else {
        Err("OpenMVS fused no points".into())
    }
}

/// Returns the scene of the fusion in which the images of other key views have no pose: one that is
/// missing or broken keeps no others from being fused, and none costs memory.
fn scene_of(call: &Call, there: &BTreeSet<usize>) -> Result<Vec<u8>, String> {
    let path = call.workplace.join("fuse.mvs");
    let bytes = input::read(&path, FileKind::Sparse).map_err(text)?;
    let again = |_| format!("{}: not what viewrank wrote: export again", path.display());
    let mut scene = Mvs::read(&bytes).map_err(again)?;
    for (i, image) in scene.images.iter_mut().enumerate() {
        if !there.contains(&i) {
            image.pose = NO_POSE;
        }
    }
    Ok(scene.write())
}

/// Returns for each image of the fusion those that are there and overlap it. A list must not be
/// empty: a map that none overlaps is compared with any image of the scene.
fn overlaps_among(run: &Run, there: &BTreeSet<usize>) -> Vec<Vec<usize>> {
    let of = |(i, overlaps): (usize, &Vec<usize>)| {
        if !there.contains(&i) {
            return Vec::new();
        }
        let others = overlaps
            .iter()
            .copied()
            .filter(|other| there.contains(other));
        let others: Vec<usize> = others.collect();
        if !others.is_empty() {
            return others;
        }
        let any = there.iter().copied().find(|&other| other != i);
        vec![any.unwrap_or(usize::from(i == 0))]
    };
    run.overlaps.iter().enumerate().map(of).collect()
}

/// Width and height at which images of a size are matched, by the rule of OpenMVS
/// (`TImage::computeMaxResolution`).
fn size_at(size: [u32; 2], resolution: u32) -> [u32; 2] {
    let side = size[0].max(size[1]);
    let scale = f64::from(side.min(resolution)) / f64::from(side.max(1));
    size.map(|length| (f64::from(length) * scale).round() as u32)
}

/// Fails if there are maps of two kinds; `maps`: one of each.
pub fn refuse_two_kinds(maps: &BTreeMap<&str, &str>) -> Result<(), String> {
    let [(one, map), (other, other_map), ..] = Vec::from_iter(maps)[..] else {
        return Ok(());
    };
    Err(format!(
        "{map} is of the kind {one}, {other_map} of the kind {other}, and OpenMVS fuses only maps of the kind that it \
         writes: name the version that made them with --program, or move the depth*.dmap away to compute all again"
    ))
}
