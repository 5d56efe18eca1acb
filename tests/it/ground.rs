//! What a surveyor asks of a region: did I miss something? In metres, where these are known.

use std::fs;

use serde_json::{Value, json};
use viewrank_io::formats::colmap::ColmapModel;

use crate::one_door::{Folder, said, scene, viewrank};

const LATITUDE: f64 = 52.0;
const LONGITUDE: f64 = 21.0;

/// A flight over the square from -25 to 25 m, whose model is in metres east and north of a place.
fn flight(settings: &str) -> Folder {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"))
        .write("viewrank.toml", settings);
    folder
}

fn georeferenced() -> Folder {
    flight(&format!("frame.origin = [{LATITUDE}, {LONGITUDE}, 0]\n"))
}

/// GeoJSON of a rectangle, metres east and north.
fn site(folder: &Folder, [west, south, east, north]: [f64; 4]) -> String {
    let metre = 1.0 / 111_250.0;
    let at = |x: f64, y: f64| {
        let along = LATITUDE.to_radians().cos() * 111_320.0;
        [LONGITUDE + x / along, LATITUDE + y * metre]
    };
    let ring = [
        at(west, south),
        at(east, south),
        at(east, north),
        at(west, north),
        at(west, south),
    ];
    let geometry = json!({ "type": "Polygon", "coordinates": [ring] });
    folder.write("site.geojson", geometry.to_string());
    folder.at("site.geojson").to_str().unwrap().to_owned()
}

fn manifest(folder: &Folder) -> Value {
    serde_json::from_slice(&fs::read(folder.at("viewrank/manifest.json")).unwrap()).unwrap()
}

#[test]
fn what_the_photographs_miss_of_a_region_is_said_first() {
    let folder = georeferenced();
    // A fifth of it was flown over.
    let region = site(&folder, [-10.0, -10.0, 200.0, 10.0]);
    let (code, stdout, stderr) = folder.plan(&["--region", &region, "--backend", "sgm"]);
    assert_eq!(code, 0, "{stderr}");
    let ground = &manifest(&folder)["region"]["ground"];
    let number = |key: &str| ground[key].as_f64().unwrap();
    assert!((number("area") - 4200.0).abs() < 42.0, "{ground}");
    assert!((0.1..0.2).contains(&number("surface")), "{ground}");
    assert!((0.7..0.85).contains(&number("unseen")), "{ground}");
    let percent = format!("{:.1} %", 100.0 * number("unseen"));
    let missed = format!("No photograph shows {percent} of the region");
    assert!(
        stdout.contains(&missed) && stdout.contains("m² on the map"),
        "{stdout}"
    );
    // Once: as a warning only where there is no summary.
    assert!(!stderr.contains(&missed), "{stderr}");
    let (_, _, warned) = folder.plan(&["--region", &region, "--backend", "sgm", "--quiet"]);
    assert!(warned.contains(&missed), "{warned}");
    let (code, found, _) = said(&viewrank(&["doctor", folder.path().to_str().unwrap()]));
    assert!(code == 3 && found.contains(&percent), "{found}");
    // What was missed comes first, then the depth maps; of files that are not there nothing is
    // said.
    let next = stdout.find("Next, what was missed").unwrap();
    assert!(
        stdout[next..].contains("\nThen: ") && stdout[next..].contains("viewrank report"),
        "{stdout}"
    );
    assert!(!stderr.contains("flight") && !folder.at("viewrank/flight").exists());
}

#[test]
fn doctor_judges_a_region_before_anything_is_planned() {
    let folder = georeferenced();
    let root = folder.path().to_str().unwrap().to_owned();
    let doctor = |region: &str| said(&viewrank(&["doctor", &root, "--region", region]));
    let (code, missed, _) = doctor(&site(&folder, [-10.0, -10.0, 200.0, 10.0]));
    assert!(
        code == 3 && missed.contains("No photograph shows"),
        "{missed}"
    );
    assert!(
        missed.contains("--region") && missed.contains("--report"),
        "{missed}"
    );
    // What a surface hides only a plan knows.
    let words: Vec<&str> = missed.split_whitespace().collect();
    assert!(words.join(" ").contains("takes the ground for a plane"));
    let (code, whole, _) = doctor(&site(&folder, [-10.0, -10.0, 10.0, 10.0]));
    assert!(
        code == 0 && whole.contains("nothing: it is covered"),
        "{whole}"
    );
    let (code, found, _) = doctor("nowhere.geojson");
    assert!(code == 4 && found.contains("nowhere.geojson"), "{found}");
    assert!(!folder.at("viewrank").exists());
}

#[test]
fn ground_that_is_seen_too_coarsely_is_told_from_ground_that_is_not_seen() {
    let own = scene().median_gsd().unwrap();
    let origin = format!("frame.origin = [{LATITUDE}, {LONGITUDE}, 0]\n");
    let folder = flight(&format!("{origin}target.gsd = {}\n", own / 10.0));
    let root = folder.path().to_str().unwrap().to_owned();
    let doctor = |region: &str| said(&viewrank(&["doctor", &root, "--region", region]));
    let (code, within, _) = doctor(&site(&folder, [-10.0, -10.0, 10.0, 10.0]));
    assert!(
        code == 4 && within.contains("finely") && within.contains("target.gsd"),
        "{within}"
    );
    let (code, partly, _) = doctor(&site(&folder, [-10.0, -10.0, 200.0, 10.0]));
    assert!(code == 4 && partly.contains("none shows"), "{partly}");
    // What is only far outside has another reason.
    let (code, outside, _) = doctor(&site(&folder, [1000.0, 1000.0, 1100.0, 1100.0]));
    assert!(code == 4 && !outside.contains("finely"), "{outside}");
}

#[test]
fn a_resolution_that_the_photographs_lack_is_said() {
    let folder = flight("");
    let (_, as_it_is, _) = folder.plan(&["--backend", "sgm"]);
    assert!(as_it_is.contains("\nNext: "), "{as_it_is}");
    let own = scene().median_gsd().unwrap();
    let finer = format!("{}", own / 4.0);
    let (code, stdout, stderr) = folder.plan(&["--backend", "sgm", "--gsd", &finer]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        stdout.contains("No view cluster reconstructs") && stdout.contains("Then: "),
        "{stdout}"
    );
    assert!(
        stdout.contains("; the images have ") && !as_it_is.contains("the images have"),
        "{stdout}"
    );
}

#[test]
fn a_surface_that_is_seen_too_coarsely_is_missed_and_gets_images() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 10.0, 10.0]);
    let (code, stdout, stderr) = folder.plan(&["--region", &region, "--backend", "sgm"]);
    assert_eq!(code, 0, "{stderr}");
    let root = folder.path().to_str().unwrap();
    let (code, covered, _) = said(&viewrank(&["doctor", root]));
    assert!(code != 4 && !covered.contains("finely"), "{covered}");
    let finer = format!("{}", scene().median_gsd().unwrap() / 10.0);
    // The region is that of the plan.
    let (_, coarse, _) = said(&viewrank(&["doctor", root, "--gsd", &finer]));
    assert!(coarse.contains("finely enough"), "{coarse}\n{stdout}");
    let wanted = ["--region", &region, "--gsd", &finer, "--backend", "sgm"];
    let (code, stdout, stderr) = folder.plan(&[&wanted[..], &["--report"]].concat());
    assert_eq!(code, 0, "{stderr}");
    let ground = &manifest(&folder)["region"]["ground"];
    assert_eq!(ground["unseen"], 1.0, "{stdout}");
    assert_eq!(ground["too_coarse"], 1.0);
    assert!(ground["surface"].as_f64().unwrap() > 0.5);
    let flown = fs::read_to_string(folder.at("viewrank/flight/waypoints.csv")).unwrap();
    assert!(flown.contains("bare ground"), "{flown}");
}

#[test]
fn a_plan_without_the_region_of_the_plan_before_says_so() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 10.0, 10.0]);
    let (_, first, _) = folder.plan(&["--region", &region, "--backend", "sgm"]);
    assert!(!first.contains("The plan before"), "{first}");
    let (_, second, _) = folder.plan(&["--backend", "sgm"]);
    // The line may break at the path.
    let second = second.split_whitespace().collect::<Vec<_>>().join(" ");
    let again = format!("--region {region} brings it back");
    assert!(
        second.contains("The plan before was for a region") && second.contains(&again),
        "{second}"
    );
    let (_, third, _) = folder.plan(&["--backend", "sgm"]);
    assert!(!third.contains("The plan before"), "{third}");
}

#[test]
fn a_region_within_the_flight_is_whole() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 10.0, 10.0]);
    let (code, stdout, stderr) = folder.plan(&["--region", &region, "--backend", "sgm"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        stdout.contains("3 photographs or more show all of the region"),
        "{stdout}"
    );
    assert!(!stderr.contains("No photograph"), "{stderr}");
    assert_eq!(manifest(&folder)["region"]["ground"]["unseen"], 0.0);
}

#[test]
fn a_doctor_without_a_plan_counts_the_photographs_of_the_region() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 200.0, 10.0]);
    let settings = fs::read_to_string(folder.at("viewrank.toml")).unwrap();
    folder.write("viewrank.toml", format!("region = {region:?}\n{settings}"));
    let (_, found, _) = said(&viewrank(&["doctor", folder.path().to_str().unwrap()]));
    assert!(
        found.contains("the region covers") && found.contains("No photograph"),
        "{found}"
    );
}

#[test]
fn images_beyond_the_most_that_are_planned_are_counted() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 1500.0, 1500.0]);
    let (code, _, stderr) = folder.plan(&["--region", &region, "--backend", "sgm", "--report"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stderr.contains("more: use a coarser --gsd"), "{stderr}");
    let flown = fs::read_to_string(folder.at("viewrank/flight/waypoints.geojson")).unwrap();
    let flown: Value = serde_json::from_str(&flown).unwrap();
    let note = flown["note"].as_str().unwrap();
    assert!(note.contains("would take about"), "{note}");
    assert!(flown["features"].as_array().unwrap().len() >= 2000);
}

#[test]
fn ground_without_photographs_gets_images_and_the_page_has_the_whole_region() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 90.0, 10.0]);
    let (code, _, stderr) = folder.plan(&["--region", &region, "--backend", "sgm", "--report"]);
    assert_eq!(code, 0, "{stderr}");
    let flown = fs::read_to_string(folder.at("viewrank/flight/waypoints.geojson")).unwrap();
    let flown: Value = serde_json::from_str(&flown).unwrap();
    let straight_down: Vec<&Value> = flown["features"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|waypoint| waypoint["properties"]["gimbal_pitch_deg"] == -90.0)
        .collect();
    // North is up the map, however the vertical of a place differs from that of the map.
    let is_north = |waypoint: &&&Value| waypoint["properties"]["heading_deg"] == 0.0;
    assert!(straight_down.iter().all(|waypoint| is_north(&waypoint)));
    let straight_down: Vec<f64> = straight_down
        .iter()
        .map(|waypoint| waypoint["geometry"]["coordinates"][0].as_f64().unwrap())
        .collect();
    let east = |metres: f64| LONGITUDE + metres / (LATITUDE.to_radians().cos() * 111_320.0);
    let between = |low: f64, high: f64| {
        let inside = straight_down
            .iter()
            .filter(|x| (east(low)..east(high)).contains(x));
        inside.count()
    };
    // All over what was missed, no more than it takes, and not over what was flown.
    for west in [40.0, 55.0, 70.0] {
        assert!(between(west, west + 15.0) >= 1, "{west}: {straight_down:?}");
    }
    assert!(straight_down.len() <= 12, "{straight_down:?}");
    assert_eq!(between(-15.0, 10.0), 0, "{straight_down:?}");
    // A map layer of what was missed.
    let missed = fs::read_to_string(folder.at("viewrank/flight/missed.geojson")).unwrap();
    let missed: Value = serde_json::from_str(&missed).unwrap();
    // The files say what they are for, to tell them from those of another plan.
    for file in [&flown, &missed] {
        let note = file["note"].as_str().unwrap();
        assert!(
            note.contains("m per pixel; region: site.geojson."),
            "{note}"
        );
    }
    let note = flown["note"].as_str().unwrap();
    assert!(note.contains("m apart on a line"), "{note}");
    let total = missed["note"].as_str().unwrap();
    assert!(
        total.contains("no photograph shows finely enough: ") && total.contains(" m²"),
        "{total}"
    );
    let unseen = &missed["features"][0];
    assert_eq!(unseen["properties"]["photographs"], 0);
    let outline = unseen["geometry"]["coordinates"][0].as_array().unwrap();
    assert_eq!(outline.first(), outline.last());
    let longitudes = outline.iter().map(|corner| corner[0].as_f64().unwrap());
    let (west, east_end) = longitudes.fold((f64::MAX, f64::MIN), |(low, high), x| {
        (low.min(x), high.max(x))
    });
    let length = (east_end - west) / (east(1.0) - LONGITUDE);
    // From the last photograph's reach to the end of the site, 20 m wide.
    assert!((45.0..70.0).contains(&length), "{length}");
    let area = unseen["properties"]["area_m2"].as_f64().unwrap();
    assert!(
        (0.8 * 20.0 * length..1.05 * 20.0 * length).contains(&area),
        "{area}"
    );
    let page = fs::read_to_string(folder.at("viewrank/report.html")).unwrap();
    let data = page
        .split_once("<script id=\"data\" type=\"application/json\">")
        .unwrap()
        .1;
    let data: Value = serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap();
    assert_eq!(data["metres"], 1.0);
    assert_eq!(data["region"]["outline"].as_array().unwrap().len(), 1);
    let high = data["subject"]["high"][0].as_f64().unwrap();
    assert!((high - data["subject"]["low"][0].as_f64().unwrap()) > 95.0);
    let bare = data["holes"].as_array().unwrap().last().unwrap();
    assert!(
        bare["missing"].as_str().unwrap().contains("bare ground"),
        "{bare}"
    );
}

#[test]
fn images_to_take_of_an_earlier_plan_are_told() {
    let folder = georeferenced();
    let said = |region: [f64; 4], options: &[&str]| {
        let region = site(&folder, region);
        let all = [&["--region", &region, "--backend", "sgm"], options].concat();
        let (code, _, stderr) = folder.plan(&all);
        assert_eq!(code, 0, "{stderr}");
        stderr.contains("viewrank/flight is of an earlier plan")
    };
    let (first, second) = ([-10.0, -10.0, 90.0, 10.0], [-10.0, -10.0, 60.0, 10.0]);
    assert!(!said(first, &["--report"]) && !said(first, &[]));
    // The first time, and after that.
    assert!(said(second, &[]) && said(second, &[]));
    assert!(!said(second, &["--report"]));
}

#[test]
fn images_for_maps_of_a_quarter_of_their_size_say_what_a_photograph_must_show() {
    let folder = flight(&format!(
        "frame.origin = [{LATITUDE}, {LONGITUDE}, 0]\nimage_scale = 0.25\n"
    ));
    let region = site(&folder, [-10.0, -10.0, 200.0, 10.0]);
    let plan = ["--region", &region, "--gsd", "0.4", "--backend", "sgm"];
    let (code, _, stderr) = folder.plan(&[&plan[..], &["--report"]].concat());
    assert_eq!(code, 0, "{stderr}");
    let said =
        "0.400 m per pixel in depth maps at image_scale 0.25, so 0.100 m per pixel in a photograph";
    for file in ["viewrank/flight/missed.geojson", "viewrank/report.html"] {
        let text = fs::read_to_string(folder.at(file)).unwrap();
        assert!(text.contains(said), "{file}: {text}");
    }
}

#[test]
fn slivers_of_missed_ground_are_summed_not_drawn() {
    let folder = georeferenced();
    let region = site(&folder, [-40.0, -40.0, 40.0, 40.0]);
    let (code, _, stderr) = folder.plan(&["--region", &region, "--backend", "sgm", "--report"]);
    assert_eq!(code, 0, "{stderr}");
    let missed = fs::read_to_string(folder.at("viewrank/flight/missed.geojson")).unwrap();
    let missed: Value = serde_json::from_str(&missed).unwrap();
    let areas = missed["features"].as_array().unwrap().iter();
    let areas: Vec<f64> = areas
        .map(|of| of["properties"]["area_m2"].as_f64().unwrap())
        .collect();
    let cell = manifest(&folder)["region"]["ground"]["area"]
        .as_f64()
        .unwrap()
        / 16_384.0;
    assert!(
        areas.iter().all(|area| *area > 3.5 * cell),
        "{areas:?} {cell}"
    );
}

#[test]
fn lengths_are_metres_where_the_model_has_a_place_on_earth() {
    let plan = |folder: &Folder, options: &[&str]| {
        let options = [&["--backend", "sgm", "--format", "json"], options].concat();
        let (code, stdout, stderr) = folder.plan(&options);
        let summary = serde_json::from_str::<Value>(&stdout).unwrap_or_default();
        (code, summary, stderr)
    };
    let folder = georeferenced();
    let (code, summary, stderr) = plan(&folder, &["--gsd", "60cm"]);
    assert_eq!(code, 0, "{stderr}");
    assert_eq!(
        (&summary["gsd"], &summary["metres_per_unit"]),
        (&json!(0.6), &json!(1.0))
    );
    assert_eq!(summary["units"], "metric");
    // The user's word counts before all.
    let relative = flight(&format!(
        "units = \"relative\"\nframe.origin = [{LATITUDE}, {LONGITUDE}, 0]\n"
    ));
    let (code, _, stderr) = plan(&relative, &["--gsd", "60cm"]);
    assert!(code == 2 && stderr.contains("unit of length"), "{stderr}");
    let (code, _, stderr) = plan(&flight(""), &["--gsd", "60cm"]);
    assert!(code == 2 && stderr.contains("unit of length"), "{stderr}");
    let path = folder.path().to_str().unwrap();
    let (_, inspected, _) = said(&viewrank(&["inspect", path]));
    assert!(inspected.contains("metres"), "{inspected}");
}

#[test]
fn a_project_that_was_moved_keeps_the_region_in_it() {
    let folder = georeferenced();
    let region = site(&folder, [-10.0, -10.0, 10.0, 10.0]);
    folder.plan(&["--region", &region, "--backend", "sgm"]);
    let home = Folder::new();
    let moved = home.at("moved");
    fs::rename(folder.path(), &moved).unwrap();
    let plan = ["plan", moved.to_str().unwrap(), "--backend", "sgm"];
    let (code, again, stderr) = said(&viewrank(&plan));
    assert_eq!(code, 0, "{stderr}");
    let again = again.split_whitespace().collect::<Vec<_>>().join(" ");
    let place = format!("--region {}", moved.join("site.geojson").display());
    assert!(again.contains(&place), "{again}");
}

#[test]
fn a_box_in_degrees_is_told_what_boxes_are() {
    let folder = georeferenced();
    let degrees = "20.9995,51.9995,0,21.0005,52.0005,50";
    let (code, _, stderr) = folder.plan(&["--region", degrees, "--backend", "sgm"]);
    let stderr = stderr.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(
        code != 0 && stderr.contains("GeoJSON") && stderr.contains("look like longitude"),
        "{stderr}"
    );
    assert!(!folder.at("viewrank/missed-region").exists());
}

#[test]
fn a_region_that_is_too_large_for_a_map_says_what_it_holds() {
    let folder = georeferenced();
    let ring = [[-180, -90], [180, -90], [180, 90], [-180, 90], [-180, -90]];
    let earth = json!({ "type": "Polygon", "coordinates": [ring] });
    folder.write("earth.geojson", earth.to_string());
    let region = folder.at("earth.geojson");
    let (_, stdout, _) = folder.plan(&["--region", region.to_str().unwrap(), "--backend", "sgm"]);
    assert!(
        stdout.contains("100.0 % of the surface is inside"),
        "{stdout}"
    );
}
