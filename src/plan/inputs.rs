//! What the stages of a plan start from: the scene, the settings in force, and what the images
//! show before any is decoded.

use std::sync::OnceLock;

use super::{Matcher, PlanError, Timings, cached::Fingerprints, georeference, region};
use crate::{
    base::{pixels::PixelBound, progress::Stage},
    config::{Settings, Share},
    decision::DEFAULT_TARGET,
    io::{
        pictures::PictureFolders,
        project::{ImageFaults, Project},
    },
    method::{
        confidence::Confidence, fulfilment::FulfilmentRule, region::RegionShape, target::GSD_MARGIN,
    },
    model::{
        cluster::MapScale,
        georeference::{Georeference, MapFrame},
        scene::{Scene, Units, ViewIndex, ViewPoints, WarningKind},
    },
};

/// Inputs of all stages.
pub(super) struct Inputs<'a> {
    pub matcher: &'a Matcher,
    /// In force: those chosen from the data or by the backend are filled in.
    pub settings: Settings,
    /// True if `settings.image_scale` is the backend's default.
    pub own_size: bool,
    /// True if maps of half the size were requested, but the backend supports only one size.
    pub refused_half: bool,
    /// Keys of settings that mean nothing for the backend, and count as not set.
    pub unfit: Vec<&'static str>,
    pub scene: Scene,
    pub points: ViewPoints,
    /// Median ground sampling distance of the model's images, scene units per pixel; `None` without
    /// points.
    pub image_gsd: Option<f64>,
    /// Place of the model on earth.
    pub place: Georeference,
    /// Metres in a scene unit; `None` if unknown.
    pub metres: Option<f64>,
    pub image_faults: ImageFaults,
    /// Pixels of the largest image; 0 without images.
    pub most_pixels: u64,
    /// Views whose image is missing or unreadable, ascending.
    pub without_image: Vec<ViewIndex>,
    /// Views that are kept apart for tests, ascending.
    pub kept_for_tests: Vec<ViewIndex>,
    pub pictures: PictureFolders,
    mask_bytes: OnceLock<u64>,
    /// How p_i is predicted (method 3.4).
    pub confidence: Confidence,
    /// The region of the settings, before it is laid over the surface.
    pub region: Option<RegionShape>,
    pub fingerprints: Fingerprints<'a>,
}

impl<'a> Inputs<'a> {
    /// Checks the images, and fills in the settings.
    pub fn new(
        project: &'a Project,
        mut scene: Scene,
        settings: &Settings,
        matcher: &'a Matcher,
        timings: &mut Timings,
    ) -> Result<Self, PlanError> {
        let unfit = unfit(settings, matcher);
        let given = settings;
        let Known {
            points,
            fingerprints,
            image_gsd,
            place,
            region,
            mut settings,
        } = timings.time(Stage::Read, || {
            Known::read(project, &scene, settings, matcher)
        })?;
        let image_faults = project.image_faults(&scene);
        refuse_unfit_images(project, &scene, &settings, &image_faults)?;
        let most_pixels = match project.images {
            Some(_) => image_faults.most_pixels(&scene),
            None => 0,
        };
        let (numbers, own) = (&matcher.numbers, &settings.confidence);
        let confidence =
            Confidence::new(own.source, own, &numbers.confidence, &numbers.photometric);
        confidence.fill_in(&mut settings.confidence);
        let without_image = image_faults.without_image(scene.views.len());
        if matcher.makes_maps {
            // Lists of test images are for trainers: depth maps are made of all images.
            scene.tests.clear();
        }
        let kept_for_tests = scene.kept_for_tests(settings.test_every, &without_image);
        Ok(Self {
            matcher,
            settings,
            own_size: given.image_scale.is_none(),
            refused_half: given.ranking.has_half() && !matcher.mixes_sizes,
            unfit,
            pictures: PictureFolders::new(project).without(&without_image),
            mask_bytes: OnceLock::new(),
            scene,
            points,
            image_gsd,
            metres: metres(given.units, &place),
            place,
            image_faults,
            most_pixels,
            without_image,
            kept_for_tests,
            confidence,
            region,
            fingerprints,
        })
    }

    /// Views that are neither key views nor partners, ascending: those without an image, and those
    /// kept apart for tests.
    pub fn left_out(&self) -> Vec<ViewIndex> {
        let (missing, tests) = (&self.without_image, &self.kept_for_tests);
        let mut left_out = [&missing[..], tests].concat();
        left_out.sort_unstable();
        left_out
    }

    /// Memory of reading the largest mask, bytes: from the headers of all, so it is looked up only
    /// where masks or pictures are read.
    pub fn most_mask_bytes(&self) -> u64 {
        *self
            .mask_bytes
            .get_or_init(|| self.pictures.most_mask_bytes(&self.scene))
    }

    /// Parameters of f.
    pub fn rule(&self) -> FulfilmentRule {
        let settings = &self.settings;
        FulfilmentRule {
            alpha: settings.fulfilment.alpha,
            sigma_px: settings.fulfilment.sigma_px,
            min_cameras: settings.coverage.min_cameras,
            image_scale: settings.image_scale(),
            confidence: self.confidence,
        }
    }
}

/// Data of a scene that need no image to be opened.
struct Known<'a> {
    points: ViewPoints,
    fingerprints: Fingerprints<'a>,
    image_gsd: Option<f64>,
    place: Georeference,
    region: Option<RegionShape>,
    /// In force.
    settings: Settings,
}

impl<'a> Known<'a> {
    fn read(
        project: &'a Project,
        scene: &Scene,
        settings: &Settings,
        matcher: &Matcher,
    ) -> Result<Self, PlanError> {
        let (points, fingerprints) =
            rayon::join(|| scene.view_points(), || Fingerprints::new(project, scene));
        let image_gsd = scene.median_gsd_of(&points);
        let mut settings = in_force(project, settings, scene, image_gsd, matcher)?;
        let place = georeference(project, scene, &settings.frame);
        // Neither, where the model's unit is some other length: a plan that is repeated with these
        // settings must find it again.
        settings.units = settings.units.or(match place.metres_per_unit() {
            Some(1.0) => Some(Units::Metric),
            Some(_) => None,
            None => Some(Units::Relative),
        });
        // Before the surface is built, so that a wrong file is refused at once.
        let region = shape(&place, scene, &settings)?;
        Ok(Self {
            points,
            fingerprints,
            image_gsd,
            place,
            region,
            settings,
        })
    }
}

/// Keys of the settings that mean nothing for the program: limits of maps where none are made, or
/// tests where nothing is trained.
fn unfit(settings: &Settings, matcher: &Matcher) -> Vec<&'static str> {
    let keys = [
        (
            "cut.time",
            settings.cut.time.is_some() && !matcher.makes_maps,
        ),
        (
            "cut.points",
            settings.cut.points.is_some() && !matcher.makes_maps,
        ),
        (
            "test_every",
            settings.test_every.is_some() && matcher.makes_maps,
        ),
    ];
    let unfit = keys.into_iter().filter(|(_, is_unfit)| *is_unfit);
    unfit.map(|(key, _)| key).collect()
}

fn refuse_unfit_images(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
    faults: &ImageFaults,
) -> Result<(), PlanError> {
    refuse_other_images(project, scene, settings)?;
    let images = project.images.as_ref();
    match images.and_then(|_| faults.usual_scale(scene)) {
        Some(images) => refuse_small_images(images, settings.image_scale()),
        None => refuse_large_cameras(scene, settings.image_scale()),
    }
}

/// Returns an error if the image folder that the user has set holds no image of the scene.
fn refuse_other_images(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
) -> Result<(), PlanError> {
    match (&project.images, scene.view_indices().next()) {
        (Some(folder), Some(first))
            if settings.images.is_some() && project.has_only_other_images(scene) =>
        {
            Err(PlanError::OtherImages {
                folder: folder.to_path_buf(),
                name: scene.name(first).into(),
            })
        }
        _ => Ok(()),
    }
}

/// Most that images are enlarged for matching. A surface has the detail at which they are matched,
/// so that cameras which claim any size would cost any time.
const MOST_ENLARGED: f64 = 8.0;

fn refuse_small_images(images: f64, image_scale: f64) -> Result<(), PlanError> {
    if image_scale > MOST_ENLARGED * images {
        return Err(PlanError::SmallImages {
            images,
            image_scale,
        });
    }
    Ok(())
}

/// Refuses cameras that no image vouches for, if they are to be matched at more pixels than any
/// image is read with: the surface gets triangles for all of them.
fn refuse_large_cameras(scene: &Scene, image_scale: f64) -> Result<(), PlanError> {
    let most = PixelBound::LARGEST.pixels() as f64;
    let scale_to_fit = |view: ViewIndex| {
        let camera = scene.camera_of(view);
        let pixels = f64::from(camera.width) * f64::from(camera.height);
        (most / pixels).sqrt()
    };
    let mut views = scene.view_indices();
    match views.find(|view| image_scale > scale_to_fit(*view)) {
        Some(view) => Err(PlanError::LargeCamera {
            name: scene.name(view).into(),
            size: [scene.camera_of(view).width, scene.camera_of(view).height],
            fits: scale_to_fit(view),
        }),
        None => Ok(()),
    }
}

/// Fills in the settings that depend on the data and the backend.
fn in_force(
    project: &Project,
    settings: &Settings,
    scene: &Scene,
    image_gsd: Option<f64>,
    matcher: &Matcher,
) -> Result<Settings, PlanError> {
    if scene.views.is_empty() {
        return Err(PlanError::NoViews {
            model: project.model.path.clone(),
            why: scene.warnings.clone(),
        });
    }
    if scene.observations() == 0 {
        return Err(no_observations(project, scene));
    }
    let mut all = settings.clone();
    all.image_scale
        .get_or_insert_with(|| matcher.image_scale(scene));
    let gsd = match all.target.gsd {
        Some(gsd) => gsd,
        None => GSD_MARGIN * image_gsd.ok_or(PlanError::NoScale)? / all.image_scale(),
    };
    all.target.accuracy.get_or_insert(gsd);
    // By the settings as given: in `all`, the accuracy is set by now.
    all.target.mode = settings.target.mode_in_force();
    all.target.gsd = Some(gsd);
    // With fewer candidates than k, no view could have k partners.
    all.partners.candidates = all.partners.candidates.max(all.partners.k);
    all.partners.gate = matcher.numbers.gate.with(&all.partners.gate).settings();
    all.ranking.support.get_or_insert(matcher.numbers.support);
    let source = all.confidence.source.in_force(project.images.is_some());
    all.confidence.source = source;
    if all.partners.k == 1 {
        // A single partner and the key view are two cameras: with three wanted, nothing would
        // count.
        all.coverage.min_cameras = 2;
    }
    let cut = &mut all.cut;
    if matcher.makes_maps {
        all.test_every = None;
    } else {
        (cut.time, cut.points) = (None, None);
    }
    if cut.budget.is_none() && cut.time.is_none() && cut.points.is_none() {
        cut.target.get_or_insert(Share(DEFAULT_TARGET));
    }
    if !matcher.mixes_sizes {
        all.ranking.scales = vec![MapScale::Full];
    }
    Ok(all)
}

/// The error of a model without points or tracks, with what its reader says of that.
fn no_observations(project: &Project, scene: &Scene) -> PlanError {
    let said = scene
        .warnings
        .iter()
        .find(|warning| warning.kind == WarningKind::NoPoints);
    PlanError::NoObservations {
        model: project.model.path.clone(),
        what: said.map_or("no view observes a sparse point".into(), |said| {
            said.text.clone()
        }),
        cure: said.and_then(|said| said.cure.clone()),
    }
}

/// Metres in a scene unit, by the user's word or the place of the model on earth.
pub fn metres(units: Option<Units>, place: &Georeference) -> Option<f64> {
    match units {
        Some(Units::Metric) => Some(1.0),
        Some(Units::Relative) => None,
        None => place.metres_per_unit(),
    }
}

/// Reads the region of the settings, before the surface is built.
fn shape(
    place: &Georeference,
    scene: &Scene,
    settings: &Settings,
) -> Result<Option<RegionShape>, PlanError> {
    let Some(choice) = &settings.region else {
        return Ok(None);
    };
    Ok(Some(region::read(
        choice,
        place,
        &MapFrame::new(scene, settings.surface.up),
    )?))
}
