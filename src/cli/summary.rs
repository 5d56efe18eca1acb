//! Summary of a plan for users who don't know the method; as JSON for programs.

use std::path::{Path, PathBuf};

use crate::{
    backends::{self, Choice},
    base::{
        decimals::significant,
        shell::{command_path, shown_path},
    },
    config::{ConfidenceSource, TriangleWeight, TypedSetting},
    io::project::Project,
    method::target::GSD_MARGIN,
    model::{georeference::Georeference, scene::Units},
    plan::{self, Cut, CutLimit, Forecast, GivenUp, Memory, Plan, Timings},
    show::{
        files::PlanFiles,
        manifest::{Manifest, RegionSummary, warnings_with},
        share::{area_of_all, grouped},
    },
};
use serde::Serialize;

/// Shares of the curve that are shown, besides the cut.
const STEPS: [f64; 4] = [0.5, 0.7, 0.8, 0.9];
/// Largest number of key views listed by name.
const NAMED: usize = 3;
/// Share of the surface that no view cluster reconstructs, up to which it is but its rim.
const LEAST_MISSED: f64 = 0.01;

#[derive(Serialize)]
pub struct Summary<'a> {
    project: String,
    backend: &'a str,
    units: Units,
    /// Metres in a scene unit; null if unknown.
    metres_per_unit: Option<f64>,
    views: usize,
    points: usize,
    triangles: usize,
    /// Finished depth maps that stay in the plan.
    finished: usize,
    /// g_d, scene units per pixel.
    gsd: f64,
    /// Median of the images, scene units per matched pixel, where another g_d was asked for.
    #[serde(skip)]
    of_images: Option<f64>,
    #[serde(skip)]
    image_scale: f64,
    /// g_d in words, with that of areas of the region.
    #[serde(skip)]
    wanted: String,
    /// Region of interest; null: the whole surface.
    region: Option<&'a RegionSummary>,
    cut: Cut,
    /// Number of limits in the settings.
    #[serde(skip)]
    limits: usize,
    forecast: Forecast,
    /// Speed-up over computing everything, if the time of matching is known.
    speed_up: Option<f64>,
    pub warnings: Vec<String>,
    written: bool,
    /// Paths relative to their folders.
    files: Vec<String>,
    /// Folder of the images; null if not found.
    images: Option<String>,
    /// Facts about the images in sentences: an unusual place, other names, GPS positions.
    notes: Vec<String>,
    /// The command that shows the plan.
    #[serde(skip)]
    look: String,
    /// The command to type next.
    next: String,
    timings: &'a Timings,
    /// Forecast memory of each stage, bytes, including what earlier stages keep.
    memory: Memory,
    /// Tiles that the surface was built in.
    tiles: usize,
    /// Reason for the choice of the backend, unless the user chose it.
    #[serde(skip)]
    chosen_for: String,
    #[serde(skip)]
    manifest: &'a Manifest,
    /// Weight of triangles in the shares.
    #[serde(skip)]
    weight: TriangleWeight,
    /// Thumbnails were matched, and the share counts the places on which they agree.
    #[serde(skip)]
    counts_places: bool,
    /// Use of the images, for a backend that matches none.
    #[serde(skip)]
    use_of_views: Option<&'static str>,
    /// Share of the surface that no view cluster fulfils, where it is more than the rim; if a
    /// region or a resolution was asked for and depth maps are made.
    #[serde(skip)]
    missed: Option<f64>,
}

/// Arguments of `viewrank plan` on which the wording of the summary depends.
pub struct Asked {
    /// A region or a resolution is given.
    pub is_survey: bool,
    /// No backend is given, and that of the previous plan is kept.
    pub keeps_backend: bool,
    /// Region of the plan that this one replaces, which is for the whole surface.
    pub dropped_region: Option<TypedSetting>,
    /// Path of the report, if one is written.
    pub page: Option<PathBuf>,
}

impl<'a> Summary<'a> {
    /// `next`: the command to type next.
    pub fn new(
        project: &Project,
        plan: &'a Plan,
        files: &'a PlanFiles,
        dry_run: bool,
        next: String,
        asked: Asked,
    ) -> Self {
        let manifest = &files.manifest;
        let images = project.images.as_ref();
        let sets = files.sets.iter();
        Self {
            project: project.home.display().to_string(),
            backend: plan.stages.backend,
            units: manifest.units,
            metres_per_unit: plan.stages.metres,
            views: plan.stages.scene.views.len(),
            points: plan.stages.scene.points.len(),
            triangles: plan.stages.surface.triangles.len(),
            finished: plan.decision.finished,
            gsd: plan.stages.settings.target.gsd.unwrap_or(f64::NAN),
            of_images: gsd_of_images(plan).filter(|_| asked.is_survey),
            image_scale: plan.stages.settings.image_scale(),
            wanted: plan.stages.wanted(),
            region: manifest.region.as_ref(),
            cut: plan.decision.cut,
            limits: plan.stages.settings.cut.limits(),
            forecast: plan.decision.forecast,
            speed_up: plan.decision.forecast.speed_up(plan.timings.total()),
            warnings: warnings_with(
                &manifest.warnings,
                &manifest.exports,
                &outdated(files, &asked),
            ),
            written: !dry_run,
            files: sets.flat_map(|set| set.files.keys().cloned()).collect(),
            images: images.map(|images| images.display().to_string()),
            chosen_for: chosen_for(project, plan, asked.keeps_backend),
            look: match &asked.page {
                Some(page) => shown_path(page),
                None => format!("viewrank report {} --open", command_path(&project.home)),
            },
            notes: {
                let dropped = asked.dropped_region.iter().map(dropped);
                dropped.chain(notes(project, plan, &files.place)).collect()
            },
            next,
            timings: &plan.timings,
            memory: plan.stages.memory,
            tiles: plan.stages.surface_stats.tiles,
            manifest,
            weight: plan.stages.settings.ranking.weight,
            counts_places: plan.stages.pilot.is_some(),
            missed: (asked.is_survey && plan.stages.makes_maps)
                .then(|| plan.unfulfilled_share())
                .filter(|share| *share > LEAST_MISSED),
            use_of_views: use_of_views(plan.stages.backend),
        }
    }

    /// Returns the lines of the summary, without [`Self::where_to_look`]; all of them if
    /// `is_verbose`.
    pub fn text(&self, is_verbose: bool) -> Vec<String> {
        let parts = [
            self.found(),
            self.advice(is_verbose),
            self.curve(),
            self.worth(is_verbose),
        ];
        let mut lines = parts.join(&String::new());
        lines.push(String::new());
        lines
    }

    fn found(&self) -> Vec<String> {
        let metres = self.metres_per_unit.unwrap_or(1.0);
        let [views, points, triangles] = [self.views, self.points, self.triangles].map(grouped);
        let on_disk = |size| {
            format!("Tables of up to {size} were kept on disk for want of memory (--max-memory).")
        };
        let mut lines = vec![format!(
            "{views} views, {points} sparse points; a surface of {triangles} triangles."
        )];
        lines.extend(self.memory.on_disk().map(on_disk));
        if self.use_of_views.is_none() {
            let of_images = self.of_images.map(|own| significant(own * metres));
            let at_scale = match self.image_scale {
                1.0 => String::new(),
                scale => format!(" at image_scale {scale}, at which photographs are judged here"),
            };
            let of_images =
                of_images.map(|own| format!("; the images have {own} in the median{at_scale}"));
            let of_images = of_images.unwrap_or_default();
            lines.push(format!("Wanted: {}{of_images}.", self.wanted));
        }
        lines.push(format!("Backend: {}{}.", self.backend, self.chosen_for));
        lines.extend(self.notes.iter().cloned());
        let region = self
            .region
            .map(|region| region.describe(self.metres_per_unit))
            .unwrap_or_default();
        lines.extend(region.lines().map(String::from));
        if let Some(share) = self.missed {
            lines.push(format!(
                "No view cluster reconstructs {} of the surface{}.",
                whole_percent(share),
                self.inside()
            ));
        }
        lines
    }

    fn advice(&self, is_verbose: bool) -> Vec<String> {
        // Finished maps are measured, so there is no band of a forecast.
        let band = if self.is_finished() {
            String::new()
        } else {
            format!(" (likely {})", self.cut.share_band)
        };
        let share = whole_percent(self.cut.share);
        if self.use_of_views.is_some() {
            return self.advice_for_images(&share, is_verbose);
        }
        let mut lines = vec![
            format!("{}:", self.what()),
            format!("{share} of {}{band}.", self.whole()),
        ];
        lines.extend([self.beyond_gate(), self.done()].into_iter().flatten());
        if is_verbose {
            lines.extend(self.given_up());
            lines.extend(self.other_shares());
        }
        lines
    }

    /// The same for a program that uses the images themselves (method 5.10).
    fn advice_for_images(&self, share: &str, is_verbose: bool) -> Vec<String> {
        let lines = [
            format!("{}:", self.what()),
            format!("{share} of {}.", self.whole()),
        ];
        let counted = "The share counts how well every photograph can be drawn again.";
        lines
            .into_iter()
            .chain(is_verbose.then(|| counted.into()))
            .collect()
    }

    /// What to compute.
    fn what(&self) -> String {
        let [maps, all] = [self.cut.clusters, self.forecast.all_maps].map(grouped);
        let [pairs, all_pairs] = [self.cut.pairs, self.forecast.all_pairs].map(grouped);
        if let Some(verb) = self.use_of_views {
            return format!("{verb} {maps} of {all} images");
        }
        if self.is_finished() {
            return format!("All depth maps of the plan are finished, {maps} of {all}");
        }
        if self.forecast.maps_at_half == 0 {
            return format!(
                "Compute {maps} of {all} depth maps ({pairs} of {all_pairs} image pairs)"
            );
        }
        let [full, half] = [
            self.forecast.maps - self.forecast.maps_at_half,
            self.forecast.maps_at_half,
        ];
        let work = 100.0 * self.forecast.work;
        match full {
            0 => {
                format!("Compute {maps} of {all} depth maps, at half size, {work:.0} % of the work")
            }
            _ => format!(
                "Compute {maps} of {all} depth maps, {full} at full and {half} at half size, {work:.0} % of the work"
            ),
        }
    }

    fn inside(&self) -> &'static str {
        self.region.map_or("", |_| " inside the region")
    }

    /// The denominator of the share.
    fn whole(&self) -> String {
        let all = self.forecast.all_maps;
        match self.use_of_views {
            Some(_) => format!("what all {} draw{}", grouped(all), self.inside()),
            None => {
                let area = area_of_all(Some(all), self.region.is_some());
                let at_half = self.forecast.maps_at_half > 0;
                area + if at_half { ", at full size" } else { "" }
            }
        }
    }

    /// The share in other weights, what all depth maps give of what is wanted, and the proven bound
    /// on any other choice of equal length (method 5.2).
    fn other_shares(&self) -> Vec<String> {
        let Cut {
            reachable,
            reachable_band,
            fulfilment,
            given_up,
            ..
        } = self.cut;
        let counted = match self.weight {
            _ if self.counts_places => "the places that thumbnails show",
            TriangleWeight::Pixels => "the pixels that show the surface",
            TriangleWeight::Area => "the area of the surface",
            TriangleWeight::Count => "triangles",
        };
        let mut lines = vec![format!("The share counts {counted}.")];
        let last = self.cut.clusters.checked_sub(1);
        let last = last.and_then(|last| self.manifest.clusters.get(last));
        lines.extend(last.map(|last| {
            format!(
                "With far ground counted as much as near it is {}.",
                whole_percent(last.area)
            )
        }));
        if given_up.single_map > 0.0 {
            lines.push(format!(
                "Planned once, but kept only if two agree: {:.1} %.",
                100.0 * given_up.single_map / reachable
            ));
        }
        lines.extend(self.region.map(|region| region.part_of_all(self.weight)));
        lines.push(format!(
            "All {} give {} of what is wanted (likely {reachable_band}).",
            grouped(self.forecast.all_maps),
            whole_percent(reachable)
        ));
        if fulfilment > 0.0 {
            let alike = match self.forecast.maps_at_half {
                0 => "length",
                _ => "work",
            };
            lines.push(format!(
                "No choice of the same {alike} is {} better.",
                self.cut.more_of_others()
            ));
        }
        lines
    }

    /// Formats the areas that the cut gives up (method 5.3), as shares of what all depth maps give.
    fn given_up(&self) -> Option<String> {
        let Cut {
            reachable,
            given_up: GivenUp { border, inside, .. },
            ..
        } = self.cut;
        if border + inside <= 0.0 {
            return None;
        }
        let share = |weight: f64| format!("{:.1} %", 100.0 * weight / reachable);
        Some(format!(
            "Left out: {} at the border, {} inside.",
            share(border),
            share(inside)
        ))
    }

    fn beyond_gate(&self) -> Option<String> {
        match self.cut.pairs_beyond_gate {
            0 => None,
            1 => Some(
                "One pair is unlikely to match: there was no better partner (partners.gate)."
                    .into(),
            ),
            n => Some(format!(
                "{} pairs are unlikely to match: there were no better partners (partners.gate).",
                grouped(n)
            )),
        }
    }

    /// True if no depth map of the plan is left to compute.
    fn is_finished(&self) -> bool {
        self.finished > 0 && self.finished == self.cut.clusters
    }

    fn done(&self) -> Option<String> {
        let last = self.finished.checked_sub(1)?;
        let reached = self.manifest.clusters[last].share * 100.0;
        let which = if self.is_finished() {
            "Measured, they".into()
        } else {
            let are = if self.finished == 1 { "is" } else { "are" };
            format!(
                "{} of them {are} finished, the first of the list: they",
                grouped(self.finished)
            )
        };
        Some(format!("{which} cover about {reached:.0} % of that area."))
    }

    /// Formats a few points of the curve.
    fn curve(&self) -> Vec<String> {
        let clusters = &self.manifest.clusters;
        let length = |share: f64| {
            clusters
                .iter()
                .position(|c| c.share >= share)
                .map(|i| i + 1)
        };
        let mut lengths: Vec<usize> = STEPS.iter().filter_map(|&share| length(share)).collect();
        lengths.extend([self.cut.clusters, clusters.len()]);
        lengths.sort_unstable();
        // The cut may be one of the steps, or the end of the list.
        lengths.dedup();
        let matched = self.use_of_views.is_none();
        let sizes = self.forecast.maps_at_half > 0;
        let mut lines = vec![String::from(match (matched, sizes) {
            (true, true) => "  depth maps     work    share",
            (true, false) => "  depth maps    pairs    share",
            (false, _) => "      images    share",
        })];
        for length in lengths {
            let pairs: usize = clusters[..length].iter().map(|c| c.partners.len()).sum();
            let quality = whole_percent(clusters[length - 1].share);
            let rest = self.forecast.all_maps.saturating_sub(length);
            let mark = match length {
                _ if length == clusters.len() && rest > 0 => {
                    format!("  <- {} more would add nothing", grouped(rest))
                }
                _ if length == self.cut.clusters => {
                    format!("  <- the plan stops here{}", self.limit())
                }
                _ => String::new(),
            };
            let pairs = match (matched, sizes) {
                (true, true) => format!(" {:>6.1} %", 100.0 * clusters[length - 1].work),
                (true, false) => format!(" {:>8}", grouped(pairs)),
                (false, _) => String::new(),
            };
            lines.push(format!(
                "  {:>10}{pairs}  {quality:>7}{mark}",
                grouped(length)
            ));
        }
        let first: Vec<&str> = clusters
            .iter()
            .take(NAMED.min(self.cut.clusters))
            .map(|c| c.key.as_str())
            .collect();
        let more = if self.cut.clusters > NAMED {
            ", ..."
        } else {
            ""
        };
        lines.extend([
            String::new(),
            format!("Best first: {}{more}", first.join(", ")),
        ]);
        lines
    }

    /// Formats which one of several limits ends the plan.
    fn limit(&self) -> &'static str {
        // A single limit needs no name.
        match self.cut.limit.filter(|_| self.limits > 1) {
            Some(CutLimit::Budget) => " (--budget)",
            Some(CutLimit::Target) => " (--target)",
            Some(CutLimit::Time) => " (--time)",
            Some(CutLimit::Points) => " (--points)",
            None => "",
        }
    }

    /// Formats whether planning is worth its time (method 5.6).
    fn worth(&self, is_verbose: bool) -> Vec<String> {
        let planning = self.timings.total();
        let time = match (self.speed_up, self.forecast.seconds) {
            (Some(speed_up), Some(_)) if speed_up < 1.0 => {
                "Computing all depth maps would be faster than planning and computing these.".into()
            }
            (Some(speed_up), Some(seconds)) => {
                format!(
                    "Matching will take about {}: {speed_up:.1} times faster than everything{}.",
                    duration(seconds),
                    if self.finished > 0 {
                        " that is left"
                    } else {
                        ""
                    }
                )
            }
            _ if self.use_of_views.is_some() => {
                return vec![format!("Planning took {planning:.1} s.")];
            }
            _ => match self.forecast.break_even(planning) {
                // Less is printed as 0.0 s.
                Some(seconds) if is_verbose && planning >= 0.05 => {
                    format!(
                        "It pays if a depth map takes more than {} s.",
                        significant(seconds)
                    )
                }
                _ => return vec![format!("Planning took {planning:.1} s.")],
            },
        };
        vec![format!("Planning took {planning:.1} s. {time}")]
    }

    /// True if a part that somebody asked for was missed.
    fn has_missed_part(&self) -> bool {
        let ground = self.region.and_then(|region| region.ground);
        ground.is_some_and(|ground| ground.is_incomplete()) || self.missed.is_some()
    }

    /// Names the results and the commands to type next, one on a line.
    pub fn where_to_look(&self) -> Vec<String> {
        let folder = Path::new(&self.project).join("viewrank");
        if self.written {
            let curve = shown_path(&folder.join("curve.svg"));
            let mut lines = vec![format!("Look at {curve} and surface.ply.")];
            let list = folder.join(self.backend).join("train_list.txt");
            if list.is_file() {
                lines.insert(0, format!("The images: {}.", shown_path(&list)));
            }
            lines.extend(if self.has_missed_part() {
                [
                    format!("Next, what was missed and images to take: {}", self.look),
                    format!("Then: {}", self.next),
                ]
            } else {
                [
                    format!("On one page: {}", self.look),
                    format!("Next: {}", self.next),
                ]
            });
            lines
        } else {
            vec![
                format!(
                    "Nothing was written (--dry-run). Would be written: {} files{} into {}.",
                    self.files.len(),
                    if self.files.iter().all(|file| file.starts_with("viewrank/")) {
                        ""
                    } else {
                        ", most"
                    },
                    shown_path(&folder)
                ),
                format!("Next: {}", self.next),
            ]
        }
    }
}

/// Returns the median of the images, scene units per matched pixel, unless the wanted one follows
/// from it.
fn gsd_of_images(plan: &Plan) -> Option<f64> {
    let settings = &plan.stages.settings;
    let own = plan.stages.scene.median_gsd()? / settings.image_scale();
    let follows = settings.target.gsd? / (GSD_MARGIN * own);
    (!(0.99..1.01).contains(&follows)).then_some(own)
}

/// Formats a share without decimals, but not as all while something is missing.
fn whole_percent(share: f64) -> String {
    let percent = 100.0 * share;
    match percent {
        percent if (99.5..99.95).contains(&percent) => format!("{percent:.1} %"),
        _ => format!("{percent:.0} %"),
    }
}

/// Says that the plan before was for a region, and how to have it again.
fn dropped(region: &TypedSetting) -> String {
    format!("The plan before was for a region; this one is for all ({region} brings it back).")
}

/// How the backend was chosen, in brackets; empty where the user named it.
fn chosen_for(project: &Project, plan: &Plan, keeps_backend: bool) -> String {
    let choice = if keeps_backend {
        Choice::Planned
    } else if plan.stages.settings.backends.is_empty() {
        backends::by_default(project).1
    } else {
        return String::new();
    };
    format!(" ({})", choice.describe())
}

/// Returns the verb for what a program without depth maps does with the images.
fn use_of_views(backend: &str) -> Option<&'static str> {
    backends::by_name(backend).ok()?.use_of_views
}

/// Returns the files of the plan before that this one has made outdated.
fn outdated(files: &PlanFiles, asked: &Asked) -> Vec<String> {
    // A page of this plan has its own.
    let flight = files.outdated_flight.iter();
    let flight = flight.filter(|_| asked.page.is_none());
    let outdated = files.outdated_exports.iter().chain(flight);
    outdated.cloned().collect()
}

/// Notes on images that may be unexpected: other names, other folders.
fn notes(project: &Project, plan: &Plan, place: &Georeference) -> Vec<String> {
    let mut notes = notes_on_folder(project);
    if project.images.is_none() {
        let what = if plan.stages.makes_maps {
            "what will match is predicted"
        } else {
            "they are ranked"
        };
        notes.push(format!("There are no images: {what} from geometry alone."));
    } else if plan.stages.settings.confidence.source == ConfidenceSource::Photometric
        && plan.stages.agreement.is_empty()
    {
        notes.push(
            "No two pictures could be compared: what will match is predicted from geometry alone."
                .into(),
        );
    }
    let caution = backends::caution(plan.stages.backend).filter(|_| plan.stages.makes_maps);
    notes.extend(caution.map(String::from));
    notes.extend(notes_on_left_out(plan));
    if plan.stages.settings.ranking.has_half() && plan.decision.forecast.maps_at_half == 0 {
        notes.push("Of two sizes, full size alone gives most within these limits.".into());
    }
    notes.extend(note_on_gps(project, plan, place));
    notes
}

/// Says whether the positions in the images place the model on earth, if there are any.
fn note_on_gps(project: &Project, plan: &Plan, place: &Georeference) -> Option<String> {
    match place {
        Georeference::Fitted {
            support: Some(support),
            ..
        } => Some(format!(
            "On earth by the GPS of {} of {} images, {} m off in the median (not with --no-gps).",
            grouped(support.fitting),
            grouped(support.positions),
            significant(support.median)
        )),
        Georeference::Local if plan.stages.settings.frame.gps => {
            plan::unused_positions_of(project, &plan.stages.scene)
        }
        _ => None,
    }
}

/// Where the images are, unless they are where and as the model says.
fn notes_on_folder(project: &Project) -> Vec<String> {
    let Some(images) = &project.images else {
        return Vec::new();
    };
    let mut notes = Vec::new();
    if images.is_searched {
        notes.push(format!(
            "The images are in {} (--images names another folder).",
            images.display()
        ));
    }
    if let Some((name, file)) = images.other_names().next() {
        notes.push(format!(
            "{} images have another name there, as {file} for {name}.",
            grouped(images.other_names().count())
        ));
    }
    notes
}

/// Notes on views that are neither key views nor partners.
fn notes_on_left_out(plan: &Plan) -> Vec<String> {
    let mut notes = Vec::new();
    let by_model = match plan.stages.settings.test_every {
        Some(_) => "",
        None => ", as the model says (--test-every 0 plans with all)",
    };
    match plan.stages.kept_for_tests.len() {
        0 => {}
        1 => notes.push(format!("1 image is kept apart for tests{by_model}.")),
        tests => notes.push(format!(
            "{} images are kept apart for tests{by_model}.",
            grouped(tests)
        )),
    }
    let missing = plan.stages.without_image.len();
    if missing > 0 {
        let (it, views) = if missing == 1 {
            ("is", "view has")
        } else {
            ("are", "views have")
        };
        notes.push(format!(
            "{} {views} no usable image and {it} neither matched nor planned.",
            grouped(missing)
        ));
    }
    if let [first, ..] = &plan.stages.scene.unregistered[..] {
        let (images, are) = match plan.stages.scene.unregistered.len() {
            1 => ("1 image".to_owned(), "is"),
            n => (format!("{} images", grouped(n)), "are"),
        };
        notes.push(format!(
            "{images} {are} not in the model (e.g. {first}): what only they show does not count."
        ));
    }
    let twins = plan.stages.twins.len();
    if twins > 0 {
        let (image, is) = match twins {
            1 => ("image shows the same from the same place as another", "is"),
            _ => ("images show the same from the same place as others", "are"),
        };
        notes.push(format!("{} {image} and {is} set aside.", grouped(twins)));
    }
    notes
}

/// Formats seconds as "3 h 20 min", "4 min" or "12 s".
pub fn duration(seconds: f64) -> String {
    let minutes = (seconds / 60.0).round() as u64;
    match minutes {
        _ if seconds < 120.0 => format!("{seconds:.0} s"),
        0..60 => format!("{minutes} min"),
        _ => format!("{} h {} min", minutes / 60, minutes % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_as_people_read_them() {
        assert_eq!(
            [0, 999, 1000, 1_234_567].map(grouped),
            ["0", "999", "1,000", "1,234,567"]
        );
        assert_eq!(
            [12.4, 90.0, 240.0, 12_000.0].map(duration),
            ["12 s", "90 s", "4 min", "3 h 20 min"]
        );
    }
}
