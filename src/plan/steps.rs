//! The stages of the method as steps of a plan, in the order of [`Stages::run`](super::Stages).

use super::{
    Memory, PlanError, PlanningNumbers,
    cached::{self, Filed, ResultFile, clusters::CachedClusters},
    inputs::Inputs,
    pilot_maps::PilotMaps,
    step::{Run, Step},
    visible_surface::VisibleSurface,
};
use crate::{
    base::progress::{Cancelled, Stage, Watcher},
    io::cache::CacheFile,
    method::{
        confidence::{self, Agreement, Confidence, ProgramReach, ReachOfPartner, Unary},
        fulfilment::{self, Model},
        geometry::Geometry,
        partners::{self, CandidateSearch, Candidates, Limits, PairGeometry, Refuses},
        pilot::{self, Places, Thumbnails},
        region::{Ground, Photographed, Region},
        twins::{self, Twin},
        visibility::Shown,
    },
    model::{
        cluster::{Reach, ViewCluster},
        georeference::MapFrame,
        scene::ViewIndex,
    },
};

/// The views that are set aside because a sharper one shows the same from the same place.
pub(super) struct TwinsStep<'a> {
    pub inputs: &'a Inputs<'a>,
}

impl Step for TwinsStep<'_> {
    const STAGE: Stage = Stage::Read;
    type Facts = ();
    type Output = Vec<Twin>;

    fn file(&self) -> CacheFile {
        self.inputs.fingerprints.twins(self.inputs)
    }

    fn unpack(&self, (): (), bytes: &[u8]) -> Option<Vec<Twin>> {
        cached::twins::unpack(bytes, self.inputs.scene.views.len())
    }

    fn compute(self, _: &mut Memory, watcher: &dyn Watcher) -> Result<Vec<Twin>, PlanError> {
        let Inputs {
            scene,
            points,
            pictures,
            settings,
            ..
        } = self.inputs;
        let excluded = twins::Excluded {
            without_image: &self.inputs.without_image,
            tests: &self.inputs.kept_for_tests,
        };
        let scale = settings.image_scale();
        Ok(twins::twins(
            scene, points, excluded, pictures, scale, watcher,
        )?)
    }
}

/// Returns the surface, and the candidate partners of each view within the gate, among pairs that
/// the backend can match, that have images and are neither set aside nor kept for tests.
pub(super) fn surface_and_candidates(
    inputs: &Inputs,
    twins: &[Twin],
    run: &mut Run,
) -> Result<(Filed<VisibleSurface>, Filed<Candidates>), PlanError> {
    let Inputs {
        scene,
        points,
        settings,
        ..
    } = inputs;
    let left_out = inputs.left_out();
    let PlanningNumbers { reach, gate, .. } = inputs.matcher.numbers;
    let gate = gate.with(&settings.partners.gate);
    // Programs without a reach differ by their gates alone, and share cached candidates.
    let program = reach.map(|_| inputs.matcher.name);
    let file = inputs
        .fingerprints
        .candidates(settings, program, &gate, &left_out, twins);
    let known = cached::read(file, |(), bytes| {
        cached::candidates::unpack(bytes, scene.views.len())
    });
    let takes_no_part = |view: &ViewIndex| {
        left_out.binary_search(view).is_ok()
            || twins.binary_search_by_key(view, |twin| twin.view).is_ok()
    };
    let refusals_of = |key| -> Refuses {
        let reach = reach.map(|rule| rule(scene, points, key, settings.image_scale()));
        Box::new(move |pair| {
            [pair.key, pair.partner].iter().any(takes_no_part)
                || reach.as_ref().is_some_and(|reach| reach.refuses(pair))
        })
    };
    let limits = Limits {
        gate: &gate,
        refusals_of: &refusals_of,
    };
    let watcher = run.watcher;
    let search = CandidateSearch::new(scene, points, &settings.partners, &limits, watcher);
    // Always replaced: the scope waits for the job.
    let mut surface = Err(Cancelled.into());
    // Parts of the surface are built by one thread, and the others find candidates meanwhile.
    // Called from outside the thread pool, these jobs wait in its queue, where threads look only
    // when nothing of the surface is left to share; on a thread of the pool, they merely run beside
    // it.
    rayon::in_place_scope_fifo(|jobs| {
        jobs.spawn_fifo(|_| {
            surface = VisibleSurface::cached_or_new(inputs, watcher, run.timings, &mut run.memory)
        });
        if known.result.is_none() {
            search.start(jobs);
        }
    });
    Ok((surface?, known.or_compute(|| search.finish())?))
}

/// Number of views, pixels and finest GSD of each triangle.
pub(super) struct ShownStep<'a> {
    pub inputs: &'a Inputs<'a>,
    pub seen: &'a Filed<VisibleSurface>,
}

impl Step for ShownStep<'_> {
    const STAGE: Stage = Stage::Visibility;
    type Facts = ();
    type Output = Shown;

    fn file(&self) -> CacheFile {
        self.inputs.fingerprints.shown(&self.seen.file.file)
    }

    fn unpack(&self, (): (), bytes: &[u8]) -> Option<Shown> {
        let triangles = self.seen.surface.triangles.len();
        cached::shown::unpack(bytes, self.inputs.scene.views.len(), triangles)
    }

    fn compute(self, _: &mut Memory, _: &dyn Watcher) -> Result<Shown, PlanError> {
        let VisibleSurface {
            surface,
            visibility,
            ..
        } = &**self.seen;
        Ok(Shown::new(&self.inputs.scene, surface, visibility))
    }
}

/// Lays the region of the settings over the surface, and counts the photographs of its area.
pub(super) fn region(
    inputs: &mut Inputs,
    twins: &[Twin],
    seen: &VisibleSurface,
    shown: &Shown,
    run: &mut Run,
) -> Result<(Option<Region>, Option<Ground>), PlanError> {
    let Some(region) = inputs.region.take() else {
        return Ok((None, None));
    };
    let watcher = run.watcher;
    run.timings.time(Stage::Visibility, || {
        let frame = MapFrame::new(&inputs.scene, inputs.settings.surface.up);
        let twins = twins.iter().map(|twin| twin.view);
        // Images kept for tests are photographs all the same.
        let missing = inputs.without_image.iter().copied();
        let mut left_out: Vec<ViewIndex> = missing.chain(twins).collect();
        left_out.sort_unstable();
        let bare = Photographed {
            scene: &inputs.scene,
            left_out: &left_out,
            gsd: seen.gsd,
            image_scale: inputs.settings.image_scale(),
            surface: None,
        };
        let footprint = region.footprint(&frame);
        // First, since it refuses outlines that take long.
        let laid_over = region
            .clone()
            .lay_over(&seen.surface, &shown.pixels, watcher)?;
        let photographs =
            bare.of_triangles(&seen.surface, &seen.visibility, &laid_over.gsd, watcher)?;
        let photographed = Photographed {
            surface: Some((&seen.surface, &photographs)),
            ..bare
        };
        let ground = match &footprint {
            Some(area) => Ground::new(area, &photographed, &frame, watcher)?,
            None => None,
        };
        Ok((Some(laid_over), ground))
    })
}

/// Unary confidence of each row of the visibility.
pub(super) struct UnaryStep<'a> {
    pub inputs: &'a Inputs<'a>,
    pub surface_file: &'a ResultFile,
    pub geometry: Geometry<'a>,
}

pub(super) struct UnaryWithWarnings {
    pub unary: Unary,
    /// A sentence for each mask that cannot be used.
    pub warnings: Vec<String>,
}

impl Step for UnaryStep<'_> {
    const STAGE: Stage = Stage::Confidence;
    type Facts = Vec<String>;
    type Output = UnaryWithWarnings;

    fn file(&self) -> CacheFile {
        let Inputs {
            scene,
            confidence,
            pictures,
            fingerprints,
            ..
        } = self.inputs;
        fingerprints.unary(scene, &self.surface_file.file, *confidence, pictures)
    }

    fn unpack(&self, warnings: Vec<String>, bytes: &[u8]) -> Option<Self::Output> {
        let rows = self.geometry.visibility.triangles.len();
        let unary = cached::unary::unpack(bytes, rows)?;
        Some(UnaryWithWarnings { unary, warnings })
    }

    fn compute(
        self,
        memory: &mut Memory,
        watcher: &dyn Watcher,
    ) -> Result<Self::Output, PlanError> {
        let Inputs {
            points,
            confidence,
            pictures,
            ..
        } = self.inputs;
        let geometry = &self.geometry;
        if let Confidence::None = confidence {
            return Ok(UnaryWithWarnings {
                unary: Unary::certain(),
                warnings: Vec::new(),
            });
        }
        let unused = pictures.unused_masks(geometry.scene);
        let (masks, faults) = if pictures.have_masks() && unused.is_none() {
            let mask_bytes = self.inputs.most_mask_bytes();
            let views_at_once = memory.before_masks(geometry, mask_bytes)?;
            Unary::of_masks(geometry, pictures, views_at_once, watcher)?
        } else {
            Default::default()
        };
        let Geometry {
            scene,
            surface,
            visibility,
            ..
        } = *geometry;
        let nearby = confidence::nearby(scene, points, surface, visibility, watcher)?;
        let broken = match confidence {
            // A mask that cannot be used is named with its picture.
            Confidence::Photometric { .. } if pictures.have_images() => Vec::new(),
            _ => confidence::picture_warnings(scene, &faults, confidence::ALL_COUNTS),
        };
        let unused = unused.map(|[what, cure]| format!("{what}: {cure}"));
        Ok(UnaryWithWarnings {
            unary: nearby.within(masks),
            warnings: unused.into_iter().chain(broken).collect(),
        })
    }
}

/// Compares the pictures of candidate pairs, within what the backend can match of each, if
/// confidence is photometric; thumbnails are taken of those that are read.
pub(super) fn agreement(
    inputs: &Inputs,
    geometry: &Geometry,
    candidates: &Candidates,
    thumbnails: &Thumbnails,
    run: &mut Run,
) -> Result<Option<Filed<Agreement>>, PlanError> {
    let Inputs {
        matcher,
        points,
        pictures,
        ..
    } = inputs;
    if !matches!(inputs.confidence, Confidence::Photometric { .. }) {
        return Ok(None);
    }
    let of_key_view = |key| -> ReachOfPartner {
        let Some(rule) = matcher.numbers.reach else {
            return Box::new(|_| Reach::Everything);
        };
        let pairs = rule(geometry.scene, points, key, geometry.image_scale);
        Box::new(move |partner| {
            let shared = points.shared(key, partner);
            pairs.reach(&PairGeometry::new(geometry.scene, key, partner, &shared))
        })
    };
    let reach = ProgramReach {
        program: matcher.numbers.reach.map(|_| matcher.name),
        of_key_view: &of_key_view,
    };
    let partners = |view| candidates.candidates_of(view);
    let watcher = run.watcher;
    run.timings.time(Stage::Confidence, || {
        let file = cached::agreement::file(geometry, pictures, partners, reach.program);
        let compared = cached::agreement::read(file, geometry, partners)?.or_compute(|| {
            let pictures = thumbnails.beside(pictures);
            // Forecast only here: a cached table takes no pictures into memory.
            let room = run
                .memory
                .before_pictures(geometry, inputs.most_mask_bytes())?;
            let agreement = Agreement::new(geometry, &pictures, partners, &reach, room, watcher)?;
            Ok::<_, PlanError>(agreement)
        });
        compared.map(Some)
    })
}

/// The clusters, and their fulfilment at full and, if there is a choice of sizes, at half size.
pub(super) struct ClustersStep<'a> {
    pub inputs: &'a Inputs<'a>,
    /// The files of surface, candidates and unary confidence.
    pub from: [&'a ResultFile; 3],
    pub agreement_file: Option<&'a ResultFile>,
    pub model: Model<'a>,
    pub candidates: &'a Candidates,
}

impl Step for ClustersStep<'_> {
    const STAGE: Stage = Stage::Partners;
    type Facts = ();
    type Output = CachedClusters;

    fn file(&self) -> CacheFile {
        let Model {
            agreement,
            target,
            rule,
            ..
        } = &self.model;
        // An empty table changes no cluster, whatever it was made from.
        let compared = if agreement.is_empty() {
            Some("")
        } else {
            self.agreement_file.and_then(|file| file.file.inputs())
        };
        let (settings, from) = (&self.inputs.settings, self.from.map(|file| &file.file));
        let fingerprints = &self.inputs.fingerprints;
        fingerprints.clusters(settings, from, compared, target, rule)
    }

    fn unpack(&self, (): (), bytes: &[u8]) -> Option<CachedClusters> {
        let has_half = self.inputs.settings.ranking.has_half();
        cached::clusters::unpack(bytes, self.model.visibility, has_half)
    }

    fn compute(self, _: &mut Memory, watcher: &dyn Watcher) -> Result<CachedClusters, PlanError> {
        let (model, settings) = (&self.model, &self.inputs.settings);
        let (clusters, fulfilment) = partners::choose(
            model,
            self.candidates,
            &settings.partners,
            settings.seed,
            watcher,
        )?;
        if !settings.ranking.has_half() {
            return Ok(CachedClusters {
                clusters,
                fulfilment,
                half: None,
            });
        }
        let worth = settings.ranking.half_worth;
        let half = fulfilment::half_size(model, &clusters, &fulfilment, worth, watcher)?;
        Ok(CachedClusters {
            clusters,
            fulfilment,
            half: Some(half),
        })
    }
}

/// Returns the places that a pilot finds, if there are maps or pictures to find them in. `support`:
/// maps that fusion wants to agree.
pub(super) fn pilot(
    inputs: &Inputs,
    clusters: &Filed<CachedClusters>,
    support: u32,
    thumbnails: Thumbnails,
    run: &mut Run,
) -> Result<Option<Filed<Places>>, PlanError> {
    let folder = inputs.settings.pilot.maps.as_deref();
    let made =
        folder.map(|folder| PilotMaps::find(folder, &inputs.scene, inputs.pictures.project()));
    let made = made.transpose()?;
    let has_pictures = matches!(inputs.confidence, Confidence::Photometric { .. })
        && inputs.pictures.have_images();
    if !inputs.matcher.makes_maps || !(has_pictures || made.is_some()) {
        return Ok(None);
    }
    let places = run.step(PilotStep {
        inputs,
        clusters_file: &clusters.file,
        clusters: &clusters.clusters,
        made: made.as_ref(),
        thumbnails,
        support,
    })?;
    Ok(Some(places))
}

/// The places that the maps of the clusters in thumbnails show.
struct PilotStep<'a> {
    inputs: &'a Inputs<'a>,
    clusters_file: &'a ResultFile,
    clusters: &'a [ViewCluster],
    /// Maps of the program, which take the place of own ones.
    made: Option<&'a PilotMaps>,
    /// Those that were taken while pictures were compared.
    thumbnails: Thumbnails,
    support: u32,
}

impl Step for PilotStep<'_> {
    const STAGE: Stage = Stage::Pilot;
    type Facts = ();
    type Output = Places;

    fn file(&self) -> CacheFile {
        let Inputs {
            scene, pictures, ..
        } = self.inputs;
        self.inputs.fingerprints.pilot(
            scene,
            &self.clusters_file.file,
            pictures,
            self.made,
            self.support,
        )
    }

    fn unpack(&self, (): (), bytes: &[u8]) -> Option<Places> {
        cached::pilot::unpack(bytes, self.clusters)
    }

    fn compute(self, memory: &mut Memory, watcher: &dyn Watcher) -> Result<Places, PlanError> {
        let Inputs {
            scene,
            points,
            pictures,
            settings,
            ..
        } = self.inputs;
        memory.before_pilot()?;
        let seen = (
            pictures as &dyn confidence::Pictures,
            settings.image_scale(),
        );
        let made = match self.made {
            Some(made) => made.read(scene, self.clusters, watcher)?,
            None => vec![None; self.clusters.len()],
        };
        let maps = pilot::maps(
            scene,
            points,
            self.clusters,
            made,
            self.thumbnails,
            seen,
            watcher,
        )?;
        let smaller = pilot::smaller(&self.inputs.scene, settings.image_scale());
        Ok(Places::new(
            self.clusters,
            maps,
            self.support,
            smaller,
            watcher,
        )?)
    }
}
