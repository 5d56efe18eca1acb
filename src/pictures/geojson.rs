//! `views.geojson`: where the views are and what they see, for QGIS and other geographic programs (RFC 7946).

use nalgebra::Point3;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::{MapFrame, footprint};
use crate::{georeference::Georeference, plan::Plan, scene::ViewIndex};

/// A point where the camera is and a polygon round what it sees of the surface, for each view. In longitude and latitude where the place
/// of the model on the earth is known; else in the model's own coordinates, which `crs: null` and `frame` say.
pub fn views_geojson(plan: &Plan, place: &Georeference) -> String {
    let frame = MapFrame::new(&plan.scene, plan.settings.surface.up);
    let local = *place == Georeference::Local;
    let position = |point: &Point3<f64>| match place.geodetic(point) {
        Some(at) => vec![rounded(at.longitude, 9), rounded(at.latitude, 9), rounded(at.height, 4)],
        None => point.iter().map(|x| rounded(*x, 6)).collect(),
    };
    let mut rank = vec![None; plan.scene.views.len()];
    plan.ranked().enumerate().for_each(|(i, cluster)| rank[cluster.key.at()] = Some(i));
    let features = |view: ViewIndex| {
        let properties = |what: &str| properties(plan, view, rank[view.at()], what);
        let centre = plan.scene.view(view).cam_from_world.centre();
        let point = json!({ "type": "Point", "coordinates": position(&centre) });
        let mut features = vec![feature(point, properties("camera"))];
        let mut corners: Vec<_> =
            footprint(&plan.surface, &plan.visibility, view, &frame).iter().map(&position).collect();
        if corners.len() >= 3 {
            corners.push(corners[0].clone());
            features.push(feature(json!({ "type": "Polygon", "coordinates": [corners] }), properties("footprint")));
        }
        features
    };
    let views: Vec<ViewIndex> = plan.scene.view_indices().collect();
    let features: Vec<Value> = views.into_par_iter().flat_map_iter(features).collect();
    let mut collection = json!({ "type": "FeatureCollection", "frame": place.words() });
    if local {
        collection["crs"] = Value::Null;
    }
    collection["features"] = features.into();
    collection.to_string() + "\n"
}

fn feature(geometry: Value, properties: Value) -> Value {
    json!({ "type": "Feature", "geometry": geometry, "properties": properties })
}

/// `rank`: from 0. Ranks in the file are from 1, as everywhere.
fn properties(plan: &Plan, view: ViewIndex, rank: Option<usize>, what: &str) -> Value {
    let (status, reason) = plan.views[view.at()];
    json!({
        "name": plan.scene.name(view),
        "what": what,
        "status": status,
        "rank": rank.map(|rank| rank + 1),
        "gain": rank.map(|rank| plan.ranking.gains[rank]),
        "share": rank.map(|rank| plan.ranking.share(rank + 1)),
        "reason": reason,
    })
}

/// More digits than a survey has say nothing.
fn rounded(number: f64, digits: i32) -> f64 {
    let scale = 10f64.powi(digits);
    (number * scale).round() / scale
}
