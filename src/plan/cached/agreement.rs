//! Cache of the agreement table: a plan reads no picture that an earlier plan compared on the same
//! surface, with the same cameras and candidates.
//!
//! The file's facts are the views without a picture, and its contents the values, 1 byte each.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Filed, ResultFile};
use crate::{
    base::column::{ColumnBuilder, DiskError},
    io::{cache::CacheFile, output::FileSet, pictures::PictureFolders},
    method::{
        confidence::{Agreement, SPACING},
        geometry::Geometry,
    },
    model::scene::{Scene, ViewIndex},
};

/// Path of the cache in its project.
const AGREEMENT_CACHE: &str = "viewrank/cache/agreement.table";

/// Raised when the same input gives another table: by other samples, another comparison, or another
/// rule of a program's reach. Not the version of the program: comparing takes longer than all the
/// rest.
const VERSION: &str = "agreement 8";
/// Values read at once.
const BLOCK: usize = 1 << 20;

#[derive(Serialize, Deserialize)]
struct Facts {
    /// Views without a usable picture, ascending.
    without: Vec<u32>,
    /// Views whose picture is damaged or has the wrong aspect ratio, ascending.
    rejected: Vec<ViewIndex>,
    warnings: Vec<String>,
    /// By view, what the two finest bands of its picture hold.
    detail: Vec<[f64; 2]>,
}

/// Returns the cache of the table. `program`: the one whose reach limits it.
pub(in crate::plan) fn file<'p>(
    geometry: &Geometry,
    pictures: &PictureFolders,
    partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
    program: Option<&str>,
) -> CacheFile {
    let inputs = inputs(geometry, pictures, partners_of, program);
    CacheFile::new(pictures.project(), AGREEMENT_CACHE, inputs)
}

/// Returns `None` if the file system has no time of change: a changed picture would go unnoticed.
fn inputs<'p>(
    geometry: &Geometry,
    pictures: &PictureFolders,
    partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
    program: Option<&str>,
) -> Option<blake3::Hasher> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&serde_json::to_vec(&(VERSION, program, pictures.without_image())).ok()?);
    // Without a reach, other points on the same surface change nothing.
    if program.is_some() {
        hash_points(&mut hasher, geometry.scene);
    }
    hash_geometry(&mut hasher, geometry);
    for view in geometry.scene.view_indices() {
        let partners = partners_of(view);
        // The length first: else a partner could pass from one view's list to the next unnoticed.
        hasher.update(&partners.len().to_le_bytes());
        partners
            .iter()
            .for_each(|partner| _ = hasher.update(&partner.0.to_le_bytes()));
        let files = pictures.stamps(geometry.scene.name(view))?;
        hasher.update(&serde_json::to_vec(&files).ok()?);
    }
    Some(hasher)
}

/// Returns the cache of the table for the next plan, unless it is there already.
pub(super) fn set(file: &ResultFile, agreement: &Agreement) -> Option<FileSet> {
    if file.is_kept {
        return None;
    }
    let facts = Facts {
        without: agreement.not_compared().map(|view| view.0).collect(),
        rejected: agreement.rejected.clone(),
        warnings: agreement.warnings.clone(),
        detail: agreement.detail.clone(),
    };
    // The column is shared, not copied: it may have gigabytes.
    Some(file.file.file(&facts, vec![agreement.values.clone()]))
}

/// Reads the cached table; `None` if it is of other inputs or damaged.
pub(in crate::plan) fn read<'p>(
    file: CacheFile,
    geometry: &Geometry,
    partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
) -> Result<Filed<Option<Agreement>>, DiskError> {
    let result = table(&file, geometry, partners_of)?;
    let is_kept = result.is_some();
    let file = ResultFile { file, is_kept };
    Ok(Filed { file, result })
}

fn table<'p>(
    file: &CacheFile,
    geometry: &Geometry,
    partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
) -> Result<Option<Agreement>, DiskError> {
    let Some(mut open) = file.open::<Facts>() else {
        return Ok(None);
    };
    let mut without = vec![false; geometry.scene.views.len()];
    for &view in &open.facts.without {
        let Some(without) = without.get_mut(view as usize) else {
            return Ok(None);
        };
        *without = true;
    }
    // The file has no offsets: they follow from the candidates and the views without a picture.
    let mut table = Agreement::laid_out(geometry, partners_of, &without);
    let mut left = table.len();
    // In blocks, not whole: where visibility is on disk, this table has no room in memory either.
    let mut values = ColumnBuilder::new(geometry.visibility.triangles.storage())?;
    let mut block = vec![0; BLOCK];
    while left > 0 {
        let block = &mut block[..left.min(BLOCK)];
        if open.fill(block).is_none() {
            return Ok(None);
        }
        values.extend(block)?;
        left -= block.len();
    }
    let Some(Facts {
        rejected,
        warnings,
        detail,
        ..
    }) = open.checked()
    else {
        return Ok(None);
    };
    let is_without = |view: &ViewIndex| without.get(view.index()).is_some_and(|&without| without);
    if detail.len() != without.len() || !detail.iter().flatten().all(|band| *band >= 0.0) {
        return Ok(None);
    }
    if !rejected.is_sorted_by(|a, b| a < b) || !rejected.iter().all(is_without) {
        return Ok(None);
    }
    table.values = Arc::new(values.finish()?);
    table.rejected = rejected;
    table.warnings = warnings;
    table.detail = detail;
    Ok(Some(table))
}

/// The sparse points and who observes them, which the reach of a program follows from.
fn hash_points(hasher: &mut blake3::Hasher, scene: &Scene) {
    scene
        .points
        .iter()
        .flat_map(|point| point.coords.as_slice())
        .for_each(|x| _ = hasher.update(&x.to_le_bytes()));
    scene
        .track_offsets
        .iter()
        .for_each(|offset| _ = hasher.update(&(*offset as u64).to_le_bytes()));
    scene
        .track_views
        .iter()
        .for_each(|view| _ = hasher.update(&view.0.to_le_bytes()));
}

/// Surface, visibility, cameras, poses and the size of samples.
fn hash_geometry(hasher: &mut blake3::Hasher, geometry: &Geometry) {
    let Geometry {
        scene,
        surface,
        visibility,
        image_scale,
        ..
    } = *geometry;
    let mut add = |numbers: &[f64]| {
        numbers
            .iter()
            .for_each(|x| _ = hasher.update(&x.to_le_bytes()))
    };
    add(&[SPACING, image_scale, surface.vertices.len() as f64]);
    surface
        .vertices
        .iter()
        .for_each(|vertex| add(vertex.coords.as_slice()));
    for view in scene.view_indices() {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        add(pose.rotation.matrix().as_slice());
        add(pose.translation.as_slice());
        add(&[
            f64::from(camera.width),
            f64::from(camera.height),
            camera.params().len() as f64,
        ]);
        add(camera.params());
        add(&[visibility.triangles_seen_by(view).len() as f64]);
    }
    for camera in scene.view_indices().map(|view| scene.camera_of(view)) {
        hasher.update(camera.model().name().as_bytes());
    }
    hasher.update(bytemuck::cast_slice(surface.triangles.as_flattened()));
    // Part by part, so that a table on disk never fills memory.
    for part in visibility.triangles.chunks(BLOCK) {
        hasher.update(bytemuck::cast_slice(part));
        visibility.triangles.release();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::column::Storage,
        method::{
            synthetic::{SeenTown, Town},
            target::TargetSettings,
        },
    };

    #[test]
    fn other_partners_and_moved_views_have_another_fingerprint() {
        let folder = tempfile::tempdir().unwrap();
        let mut town = Town {
            edge: 4.0,
            points: 50,
            ..Town::default()
        }
        .seen(&TargetSettings::default(), 0.05, Storage::Memory);
        let pictures = PictureFolders::of(folder.path(), None);
        let fingerprint = |town: &SeenTown, partner: u32| {
            let partners = [ViewIndex(partner)];
            inputs(&town.geometry(1.0), &pictures, |_| &partners, None)
                .map(|hasher| hasher.finalize())
        };
        let first = fingerprint(&town, 7);
        assert!(first.is_some());
        assert_eq!(first, fingerprint(&town, 7));
        assert_ne!(first, fingerprint(&town, 8));
        town.scene.views[3].cam_from_world.translation.x += 1e-9;
        assert_ne!(first, fingerprint(&town, 7));
    }
}
