//! Fingerprints of what each stage depends on.
//!
//! A stage's fingerprint has the settings sections that the stage is given, whole: a setting added
//! to one of them counts without being named here.

use std::{env::consts, path::Path};

use blake3::{Hash, Hasher};
use serde::Serialize;

use crate::{
    base::input::{self, FileKind},
    config::{PartnerSettings, Settings},
    io::{cache::CacheFile, pictures::PictureFolders, project::Project},
    method::{
        confidence::Confidence, fulfilment::FulfilmentRule, ranking::Objective, target::Target,
        twins::Twin,
    },
    model::{
        cluster::Gate,
        scene::{Scene, ViewIndex},
    },
    plan::{Memory, inputs::Inputs, pilot_maps::PilotMaps},
};

/// Changes with every change of the program, also one that should not change a result.
const PROGRAM: [&str; 4] = [
    env!("CARGO_PKG_VERSION"),
    env!("VIEWRANK_SOURCES"),
    consts::OS,
    consts::ARCH,
];
/// Numbers hashed at once.
const BLOCK: usize = 1 << 12;

/// The inputs of a plan that all stages share, as the files of the stages depend on them.
pub struct Fingerprints<'a> {
    home: &'a Path,
    scene: Hash,
}

impl<'a> Fingerprints<'a> {
    /// Hashes the scene.
    pub fn new(project: &'a Project, scene: &Scene) -> Self {
        Self {
            home: &project.home,
            scene: hash_of(scene),
        }
    }

    /// The surface and its visibility. `memory`: decides, with a limit, which tables are in memory.
    pub fn surface(&self, settings: &Settings, memory: &Memory) -> CacheFile {
        let mut hasher = self.of_scene();
        let target = (&settings.target, settings.image_scale());
        add(
            &mut hasher,
            &(
                &settings.surface,
                &settings.visibility,
                target,
                memory.inputs(),
            ),
        );
        let mesh = settings
            .surface
            .mesh
            .as_deref()
            .map(|mesh| input::read(mesh, FileKind::Mesh));
        let hasher = match mesh {
            None => Some(hasher),
            Some(Ok(bytes)) => Some(add_parts(hasher, &[&bytes])),
            // Nothing is cached then; reading the mesh again says what is wrong with it.
            Some(Err(_)) => None,
        };
        CacheFile::new(self.home, "viewrank/cache/surface.table", hasher)
    }

    /// The views that are set aside: the scene, and the pictures that are compared.
    pub fn twins(&self, inputs: &Inputs) -> CacheFile {
        let hasher = || {
            let mut hasher = self.of_scene();
            add(
                &mut hasher,
                &(
                    inputs.settings.image_scale(),
                    &inputs.without_image,
                    &inputs.kept_for_tests,
                ),
            );
            for view in inputs.scene.view_indices() {
                let name = inputs.scene.name(view);
                // Only the image: masks play no part in which of two views is the sharper one.
                add(&mut hasher, &inputs.pictures.stamps(name)?[0]);
            }
            Some(hasher)
        };
        CacheFile::new(self.home, "viewrank/cache/twins.table", hasher())
    }

    /// The candidates. `program`: the one whose rule refuses pairs.
    pub fn candidates(
        &self,
        settings: &Settings,
        program: Option<&str>,
        gate: &Gate,
        left_out: &[ViewIndex],
        twins: &[Twin],
    ) -> CacheFile {
        let mut hasher = self.of_scene();
        let PartnerSettings { k, candidates, .. } = settings.partners;
        add(
            &mut hasher,
            &(
                k,
                candidates,
                gate,
                program,
                settings.image_scale(),
                left_out,
                // It matters who is set aside, not for whom.
                twins.iter().map(|twin| twin.view).collect::<Vec<_>>(),
            ),
        );
        CacheFile::new(self.home, "viewrank/cache/candidates.table", Some(hasher))
    }

    /// The confidence of views by themselves.
    pub fn unary(
        &self,
        scene: &Scene,
        surface: &CacheFile,
        confidence: Confidence,
        pictures: &PictureFolders,
    ) -> CacheFile {
        let inputs = || {
            let mut hasher = self.of_results(&[surface.inputs()?]);
            // Only the form: the numbers matter where clusters are chosen, so changing them keeps
            // this result.
            let form = match confidence {
                Confidence::None => 0,
                Confidence::Pair(_) => 1,
                Confidence::Photometric { .. } => 2,
            };
            // Warnings name the folders.
            let folders: Vec<_> = pictures
                .mask_folders()
                .iter()
                .map(|folder| folder.to_string_lossy())
                .collect();
            add(&mut hasher, &(form, pictures.have_images(), folders));
            if pictures.have_masks() {
                for view in scene.view_indices() {
                    add(&mut hasher, &pictures.stamps(scene.name(view))?[1]);
                }
            }
            Some(hasher)
        };
        CacheFile::new(self.home, "viewrank/cache/confidence.table", inputs())
    }

    /// Views, pixels and finest GSD of each triangle.
    pub fn shown(&self, surface: &CacheFile) -> CacheFile {
        let inputs = || Some(self.of_results(&[surface.inputs()?]));
        CacheFile::new(self.home, "viewrank/cache/shown.table", inputs())
    }

    /// The clusters and their fulfilment, made from the results in `from` and the pictures that
    /// were compared (empty: none).
    pub fn clusters(
        &self,
        settings: &Settings,
        from: [&CacheFile; 3],
        compared: Option<&str>,
        target: &Target,
        rule: &FulfilmentRule,
    ) -> CacheFile {
        let inputs = || {
            let [surface, candidates, unary] = from;
            let mut hasher = self.of_results(&[
                surface.inputs()?,
                candidates.inputs()?,
                unary.inputs()?,
                compared?,
            ]);
            let half = settings
                .ranking
                .has_half()
                .then_some(settings.ranking.half_worth);
            // Numbers are written such that different ones differ.
            add(
                &mut hasher,
                &(
                    &settings.partners,
                    settings.seed,
                    half,
                    format!("{rule:?}"),
                    target.accuracy_over_gsd,
                ),
            );
            Some(add_parts(hasher, &[bytemuck::cast_slice(&target.gsd)]))
        };
        CacheFile::new(self.home, "viewrank/cache/clusters.table", inputs())
    }

    /// The places of the pilot: the clusters, and the pictures that they are matched in.
    /// `made`: maps of the program in place of own ones.
    pub fn pilot(
        &self,
        scene: &Scene,
        clusters: &CacheFile,
        pictures: &PictureFolders,
        made: Option<&PilotMaps>,
        support: u32,
    ) -> CacheFile {
        let inputs = || {
            let mut hasher = self.of_results(&[clusters.inputs()?]);
            // Of the support, only this matters: with 1, places that a single map shows count too.
            add(&mut hasher, &(support == 1));
            for view in scene.view_indices() {
                add(&mut hasher, &pictures.stamps(scene.name(view))?);
            }
            add(&mut hasher, &pictures.without_image());
            if let Some(made) = made {
                add(&mut hasher, &made.hashes()?);
            }
            Some(hasher)
        };
        CacheFile::new(self.home, "viewrank/cache/pilot.table", inputs())
    }

    /// The ranking without finished depth maps, with what follows from it. `makes_maps`: whether it
    /// counts by the objective, or by the images themselves. `region`: factors on the weights of
    /// the triangles.
    pub fn ranking(
        &self,
        settings: &Settings,
        clusters: &CacheFile,
        objective: &Objective,
        makes_maps: bool,
        region: Option<&[f32]>,
        work: &[[f64; 2]],
    ) -> CacheFile {
        let inputs = || {
            let mut hasher = self.of_results(&[clusters.inputs()?]);
            // The cut decides on sizes.
            let limits = settings
                .ranking
                .has_half()
                .then_some((&settings.cut, &settings.forecast));
            add(
                &mut hasher,
                &(objective.support, makes_maps, limits, region.is_some()),
            );
            let region = bytemuck::cast_slice(region.unwrap_or_default());
            Some(add_parts(
                hasher,
                &[
                    bytemuck::cast_slice(&objective.weights),
                    region,
                    bytemuck::cast_slice(work),
                ],
            ))
        };
        CacheFile::new(self.home, "viewrank/cache/ranking.table", inputs())
    }

    fn of_scene(&self) -> Hasher {
        let mut hasher = Hasher::new();
        add(&mut hasher, &(PROGRAM, self.scene.to_string()));
        hasher
    }

    fn of_results(&self, inputs: &[&str]) -> Hasher {
        let mut hasher = self.of_scene();
        add(&mut hasher, &inputs);
        hasher
    }
}

fn add(hasher: &mut Hasher, value: &impl Serialize) {
    add_part(
        hasher,
        &serde_json::to_vec(value).expect("numbers and texts are JSON"),
    );
}

/// Adds bytes with their length, so that no two lists of parts are the same.
fn add_part(hasher: &mut Hasher, bytes: &[u8]) {
    hasher.update(&(bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

fn add_parts(mut hasher: Hasher, parts: &[&[u8]]) -> Hasher {
    parts.iter().for_each(|part| add_part(&mut hasher, part));
    hasher
}

/// Hashes what stages read of a scene: all but the ids of its file, colours and warnings.
fn hash_of(scene: &Scene) -> Hash {
    let pixels = || blake3::hash(bytemuck::cast_slice(&scene.track_pixels));
    // The pixels, 16 bytes for each observation, are the largest part, and are hashed beside the
    // rest.
    let (pixels, mut hasher) = rayon::join(pixels, || {
        let mut hasher = Hasher::new();
        for camera in &scene.cameras {
            add(
                &mut hasher,
                &(
                    camera.model().name(),
                    camera.width,
                    camera.height,
                    camera.params(),
                ),
            );
        }
        for view in &scene.views {
            let (rotation, translation) = (
                view.cam_from_world.rotation,
                view.cam_from_world.translation,
            );
            add(&mut hasher, &(&view.name, view.camera.0));
            add_part(
                &mut hasher,
                bytemuck::cast_slice(rotation.matrix().as_slice()),
            );
            add_part(&mut hasher, bytemuck::cast_slice(translation.as_slice()));
        }
        // In blocks: points are not plain bytes, and one copy of all would double them.
        for part in scene.points.chunks(BLOCK) {
            let coordinates: Vec<f64> = part
                .iter()
                .flat_map(|point| point.coords.iter().copied())
                .collect();
            add_part(&mut hasher, bytemuck::cast_slice(&coordinates));
        }
        add_part(&mut hasher, bytemuck::cast_slice(&scene.track_views));
        add_part(&mut hasher, bytemuck::cast_slice(&scene.track_offsets));
        hasher
    });
    hasher.update(pixels.as_bytes());
    hasher.finalize()
}
