//! Cache of the agreement table: a plan reads no picture that an earlier plan compared on the same surface.
//!
//! One file: a line of magic, a line of JSON, and the values, 1 byte each. A file that is damaged, or was made from other pictures or for another
//! surface, other cameras or other candidates, counts as absent.

use std::{
    io::{BufRead, BufReader, Read},
    path::PathBuf,
};

use serde::{Deserialize, Serialize};

use super::{super::pictures::Pictures, Agreement, stacks::SPACING};
use crate::{
    base::column::{Column, ColumnBuilder, DiskError},
    io::output,
    method::geometry::Geometry,
    model::scene::{Scene, ViewIndex},
};

/// Path of the cache in its project.
pub const AGREEMENT_CACHE: &str = "viewrank/cache/agreement.table";

/// Its number is raised when the same input gives another table: by other samples, another comparison, or another rule of a program's reach.
const MAGIC: &str = "viewrank agreement 3\n";
/// Limit for the line of JSON, bytes: a few per view, and the warnings.
const LONGEST_HEAD: u64 = 64 << 20;
/// Values read at once.
const BLOCK: usize = 1 << 20;

/// Cached table of a project, with the fingerprint of everything that it depends on.
pub(super) struct Cache {
    project: PathBuf,
    inputs: String,
}

/// The part of a table that is read.
pub(super) struct Cached {
    /// By view: whether it lacks a usable picture.
    pub without: Vec<bool>,
    pub warnings: Vec<String>,
    pub values: Column<u8>,
}

#[derive(Serialize, Deserialize)]
struct Head {
    /// BLAKE3 of what the table depends on, hexadecimal.
    inputs: String,
    /// BLAKE3 of the values, hexadecimal.
    values: String,
    /// Views without a usable picture, ascending.
    without: Vec<u32>,
    warnings: Vec<String>,
}

impl Cache {
    /// `program`: the one whose reach limits the table. Returns `None` if the file system has no time of change: a changed picture would go unnoticed.
    pub(super) fn new<'p>(
        geometry: &Geometry,
        pictures: &Pictures,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
        program: Option<&str>,
    ) -> Option<Self> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&serde_json::to_vec(&program).ok()?);
        if program.is_some() {
            hash_points(&mut hasher, geometry.scene);
        }
        hash_geometry(&mut hasher, geometry);
        for view in geometry.scene.view_indices() {
            let partners = partners_of(view);
            hasher.update(&partners.len().to_le_bytes());
            partners.iter().for_each(|partner| _ = hasher.update(&partner.0.to_le_bytes()));
            let files = pictures.stamps(geometry.scene.name(view))?;
            hasher.update(&serde_json::to_vec(&files).ok()?);
        }
        Some(Self { project: pictures.project().into(), inputs: hasher.finalize().to_string() })
    }

    /// Reads the cached table; `None` if the file is of other inputs.
    pub(super) fn read<'p>(
        &self,
        geometry: &Geometry,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
    ) -> Result<Option<Cached>, DiskError> {
        let Some((head, mut rest)) = self.open() else { return Ok(None) };
        let mut without = vec![false; geometry.scene.views.len()];
        for view in head.without {
            let Some(without) = without.get_mut(view as usize) else { return Ok(None) };
            *without = true;
        }
        let mut left = Agreement::laid_out(geometry, partners_of, &without).len();
        let mut values = ColumnBuilder::new(geometry.visibility.triangles.storage())?;
        let (mut hasher, mut block) = (blake3::Hasher::new(), vec![0; BLOCK]);
        while left > 0 {
            let block = &mut block[..left.min(BLOCK)];
            if rest.read_exact(block).is_err() {
                return Ok(None);
            }
            hasher.update(block);
            values.extend(block)?;
            left -= block.len();
        }
        let is_whole = hasher.finalize().to_string() == head.values && rest.fill_buf().is_ok_and(<[u8]>::is_empty);
        is_whole.then(|| Ok(Cached { without, warnings: head.warnings, values: values.finish()? })).transpose()
    }

    fn open(&self) -> Option<(Head, impl BufRead + use<>)> {
        let mut file = BufReader::with_capacity(BLOCK, output::open_own(&self.project, AGREEMENT_CACHE).ok()?);
        let mut line = |most| {
            let mut text = String::new();
            file.by_ref().take(most).read_line(&mut text).ok()?;
            Some(text)
        };
        if line(MAGIC.len() as u64)? != MAGIC {
            return None;
        }
        let head: Head = serde_json::from_str(&line(LONGEST_HEAD)?).ok()?;
        (head.inputs == self.inputs).then_some((head, file))
    }

    /// Returns the bytes of the file before the values.
    pub(super) fn head(self, without: &[bool], warnings: &[String], values: &Column<u8>) -> Vec<u8> {
        let mut hasher = blake3::Hasher::new();
        for block in values.chunks(BLOCK) {
            hasher.update(block);
            values.release();
        }
        let head = Head {
            inputs: self.inputs,
            values: hasher.finalize().to_string(),
            without: (0..).zip(without).filter(|(_, without)| **without).map(|(view, _)| view).collect(),
            warnings: warnings.to_vec(),
        };
        let json = serde_json::to_string(&head).expect("numbers and texts are JSON");
        [MAGIC, &json, "\n"].concat().into_bytes()
    }
}

/// The sparse points and who observes them, which the reach of a program follows from.
fn hash_points(hasher: &mut blake3::Hasher, scene: &Scene) {
    scene.points.iter().flat_map(|point| point.coords.as_slice()).for_each(|x| _ = hasher.update(&x.to_le_bytes()));
    scene.track_offsets.iter().for_each(|offset| _ = hasher.update(&(*offset as u64).to_le_bytes()));
    scene.track_views.iter().for_each(|view| _ = hasher.update(&view.0.to_le_bytes()));
}

/// Surface, visibility, cameras, poses and the size of samples.
fn hash_geometry(hasher: &mut blake3::Hasher, geometry: &Geometry) {
    let Geometry { scene, surface, visibility, image_scale, .. } = *geometry;
    let mut add = |numbers: &[f64]| numbers.iter().for_each(|x| _ = hasher.update(&x.to_le_bytes()));
    add(&[SPACING, image_scale, surface.vertices.len() as f64]);
    surface.vertices.iter().for_each(|vertex| add(vertex.coords.as_slice()));
    for view in scene.view_indices() {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        add(pose.rotation.matrix().as_slice());
        add(pose.translation.as_slice());
        add(&[f64::from(camera.width), f64::from(camera.height), camera.params().len() as f64]);
        add(camera.params());
        add(&[visibility.triangles_seen_by(view).len() as f64]);
    }
    for camera in scene.view_indices().map(|view| scene.camera_of(view)) {
        hasher.update(camera.model().name().as_bytes());
    }
    hasher.update(bytemuck::cast_slice(surface.triangles.as_flattened()));
    for part in visibility.triangles.chunks(BLOCK) {
        hasher.update(bytemuck::cast_slice(part));
        visibility.triangles.release();
    }
}
