//! Layers of settings: which one wins, and what each refuses.

use std::{fs, mem};

use super::*;
use crate::backends::canonical_name;
use crate::model::scene::Units;

/// Loads a user's file, a project's file and command-line options.
fn load(
    user: &str,
    project: &str,
    typed: CommandLineSettings,
) -> Result<Configuration, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        Some(path)
    };
    Configuration::load(
        &Files {
            user: write("user.toml", user),
            root: None,
            project: write("project.toml", project),
        },
        typed,
        canonical_name,
    )
}

fn refused(project: &str) -> (String, String) {
    let error = load("", project, CommandLineSettings::default()).unwrap_err();
    let message = error.to_string();
    (
        message[message.find("project.toml").unwrap()..].to_owned(),
        error.hint().unwrap().to_string(),
    )
}

#[test]
fn each_layer_covers_the_one_before_and_is_named() {
    let mut typed = CommandLineSettings::default();
    typed.set("--gsd", "target.gsd", Some(0.01));
    typed.set("-k", "partners.k", None::<i64>);
    let user = "units = \"metric\"\n[target]\ngsd = 0.03\naccuracy = 0.05\n";
    let project = "partners.k = 3\n[target]\n\ngsd = 0.02\n";
    let both = load(user, project, typed).unwrap();
    assert_eq!(both.settings.target.gsd, Some(0.01));
    assert_eq!(both.settings.target.accuracy, Some(0.05));
    assert_eq!(both.settings.partners.k, 3);
    assert_eq!(both.settings.units, Some(Units::Metric));
    assert_eq!(both.source("target.gsd").to_string(), "--gsd");
    assert!(
        both.source("target.accuracy")
            .to_string()
            .ends_with("user.toml:4")
    );
    assert!(
        both.source("partners.k")
            .to_string()
            .ends_with("project.toml:1")
    );
    assert_eq!(both.source("seed"), Source::Default);
}

#[test]
fn a_quoted_name_with_a_dot_is_no_setting() {
    for text in [
        "\"partners.k\" = 2\n",
        "[partners]\nk = 3\n[\"partners.k\"]\n",
        "[partners]\n\"k.k\" = 2\n",
        "'' = 1\n",
    ] {
        let error = load("", text, CommandLineSettings::default()).unwrap_err();
        assert!(
            matches!(error, ConfigError::UnknownKey { .. }),
            "{text}: {error}"
        );
    }
    let (message, hint) = refused("seed = 1\n\"partners.k\" = 2\n");
    assert_eq!(message, "project.toml:2: unknown setting \"partners.k\"");
    assert_eq!(hint, "did you mean partners.k?");
}

#[test]
fn nothing_written_is_the_default() {
    assert_eq!(
        load("", "", CommandLineSettings::default()).unwrap(),
        Configuration::default()
    );
    let none = Files {
        user: Some("/nowhere/viewrank.toml".into()),
        ..Files::default()
    };
    assert_eq!(
        Configuration::load(&none, CommandLineSettings::default(), canonical_name)
            .unwrap()
            .settings,
        Settings::default()
    );
}

#[test]
fn unknown_keys_name_the_line_and_the_nearest() {
    for (text, message, hint) in [
        (
            "\n[partner]\nk = 3\n",
            "project.toml:2: unknown setting partner",
            "did you mean [partners]?",
        ),
        (
            "[targt]\ngsd = 1\n",
            "project.toml:1: unknown setting targt",
            "did you mean [target]?",
        ),
        (
            "gsd = 1\n",
            "project.toml:1: unknown setting gsd",
            "did you mean target.gsd?",
        ),
        (
            "[target]\ngds = 1\n",
            "project.toml:2: unknown setting target.gds",
            "did you mean target.gsd?",
        ),
        (
            "xyzzy = 1\n",
            "project.toml:1: unknown setting xyzzy",
            "run viewrank config to list all settings",
        ),
        (
            "confidence.model = 1\n",
            "project.toml:1: unknown setting confidence.model",
            "run viewrank config to list all settings",
        ),
        (
            "confidence.agre = 1\n",
            "project.toml:1: unknown setting confidence.agre",
            "did you mean confidence.agree?",
        ),
    ] {
        assert_eq!(refused(text), (message.to_owned(), hint.to_owned()));
    }
}

#[test]
fn values_out_of_range_or_type_are_refused() {
    let message = |text| refused(text).0;
    assert_eq!(
        message("fulfilment.alpha = 1.5"),
        "project.toml:1: fulfilment.alpha = 1.5: must be 0 to 1"
    );
    assert_eq!(
        message("target.gsd = -1"),
        "project.toml:1: target.gsd = -1: must be above 0 (scene units/px)"
    );
    assert_eq!(
        message("target.gsd = nan"),
        "project.toml:1: target.gsd = nan: must be above 0 (scene units/px)"
    );
    assert!(message("target.gsd = \"1 cm\"").ends_with("the model's unit of length is unknown"));
    assert!(
        message("target.gsd = \"0,02\"")
            .ends_with("must be a number with a decimal point, as 0.02")
    );
    assert!(message("target.gsd = \"fine\"").contains("must be a number"));
    assert!(message("partners.k = \"auto\"").ends_with("must be a whole number"));
    assert!(message("ranking.support = 4000000000").contains("must be 1 to 100"));
    assert!(message("partners.method = \"best\"").contains("must be "));
    assert!(message("cut.target = \"180\"").contains("a share above 0% and up to 100%"));
    assert!(
        message("surface.max_edge_factor = 10")
            .contains("must not be below surface.edge_factor, which is 20")
    );
    assert!(
        message("[confidence]\nagree = 0.3\ndiffer = 0.4")
            .contains("must not be above confidence.agree, which is 0.3")
    );
    assert!(message("target = 3").contains("target = 3"));
    assert!(message("[target\ngsd = 1").starts_with("project.toml:1: "));
    assert!(message("seed = -1").contains("seed = -1"));
}

#[test]
fn a_projects_file_names_no_commands() {
    let user = "on_target = \"touch stop\"\n[dispatch]\nsetup = \"module load colmap\"\n";
    let both = load(
        user,
        "dispatch.partition = \"mvs\"",
        CommandLineSettings::default(),
    )
    .unwrap()
    .settings;
    assert_eq!(both.on_target.as_deref(), Some("touch stop"));
    assert_eq!(
        (
            both.dispatch.setup.as_str(),
            both.dispatch.partition.as_deref()
        ),
        ("module load colmap", Some("mvs"))
    );
    let refusal =
        "project.toml:1: dispatch.setup runs commands, so a project's file may not set it";
    assert_eq!(refused("dispatch.setup = \"rm -rf /\"").0, refusal);
    assert!(
        load(
            "",
            "[dispatch]\noptions = [\"--wrap=id\"]",
            CommandLineSettings::default()
        )
        .is_err()
    );
    assert!(
        refused("\non_target = \"rm -r /\"")
            .0
            .starts_with("project.toml:2: on_target runs commands")
    );
}

#[test]
fn backends_are_known_by_name() {
    let named = load(
        "",
        "backends = [\"COLMAP\", \"meshroom\", \"colmap\"]",
        CommandLineSettings::default(),
    )
    .unwrap();
    assert_eq!(named.settings.backends, ["colmap", "alicevision"]);
    let (message, hint) = refused("\nbackends = [\"colmpa\"]");
    assert_eq!(message, "project.toml:2: no backend \"colmpa\"");
    assert!(hint.starts_with("did you mean colmap? take one of colmap, "));
}

#[test]
fn lengths_have_units_where_the_model_is_metric() {
    let mut typed = CommandLineSettings::default();
    typed.set("--gsd", "target.gsd", Some("2cm"));
    let settings = load(
        "",
        "units = \"metric\"\ntarget.accuracy = \"15 mm\"",
        typed.clone(),
    )
    .unwrap()
    .settings;
    assert_eq!(
        (settings.target.gsd, settings.target.accuracy),
        (Some(0.02), Some(0.015))
    );
    assert!(matches!(
        load("units = \"metric\"", "units = \"relative\"", typed),
        Err(ConfigError::NotMetric { .. })
    ));
    assert_eq!(
        load("", "target.gsd = \"0.5\"", CommandLineSettings::default())
            .unwrap()
            .settings
            .target
            .gsd,
        Some(0.5)
    );
}

#[test]
fn lengths_with_a_unit_are_those_of_a_model_whose_scale_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let of_model = |text: &str, typed: &str| {
        fs::write(folder.path().join("viewrank.toml"), text).unwrap();
        let files = Files {
            project: Some(folder.path().join("viewrank.toml")),
            ..Files::default()
        };
        let mut lengths = CommandLineSettings::default();
        lengths.set("--gsd", "target.gsd", Some(typed));
        let metres = |settings: &Settings| (!settings.frame.gps).then_some(0.5);
        Configuration::load_for(&files, lengths, canonical_name, &metres)
    };
    let gsd = |text: &str, typed: &str| of_model(text, typed).unwrap().settings.target.gsd;
    assert_eq!(gsd("frame.gps = false", "5cm"), Some(0.1));
    assert_eq!(gsd("frame.gps = false", "0.05"), Some(0.05));
    assert_eq!(
        gsd("frame.gps = false\nunits = \"metric\"", "5cm"),
        Some(0.05)
    );
    for text in [
        "frame.gps = true",
        "frame.gps = false\nunits = \"relative\"",
    ] {
        assert!(matches!(
            of_model(text, "5cm"),
            Err(ConfigError::NotMetric { .. })
        ));
    }
}

#[test]
fn a_watched_folder_s_settings_are_below_those_of_its_projects() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        fs::write(folder.path().join(name), text).unwrap();
        Some(folder.path().join(name))
    };
    let root = file("root.toml", "partners.k = 4\nseed = 3");
    let files = Files {
        user: file("user.toml", "seed = 1"),
        root,
        project: file("project.toml", "partners.k = 6"),
    };
    let settings = Configuration::load(&files, CommandLineSettings::default(), canonical_name)
        .unwrap()
        .settings;
    assert_eq!((settings.seed, settings.partners.k), (3, 6));
    let root = file("root.toml", "on_target = \"rm -r /\"");
    let refused = Configuration::load(
        &Files { root, ..files },
        CommandLineSettings::default(),
        canonical_name,
    );
    assert!(matches!(refused, Err(ConfigError::UserOnly { .. })));
}

#[test]
fn amounts_may_be_numbers() {
    let configuration = load("", "cut.budget = 40", CommandLineSettings::default()).unwrap();
    assert_eq!(
        configuration.settings.cut.budget,
        Some(crate::config::Budget::Clusters(40))
    );
}

#[test]
fn a_project_s_path_may_not_lead_out_of_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (project, outside) = (folder.path().join("project"), folder.path().join("maps"));
    fs::create_dir_all(project.join("maps")).unwrap();
    fs::create_dir(&outside).unwrap();
    let file = |folder: &Path, text: &str| {
        let path = folder.join("viewrank.toml");
        fs::write(&path, text).unwrap();
        Some(path)
    };
    let load =
        |files: Files| Configuration::load(&files, CommandLineSettings::default(), canonical_name);
    let of_project = |text: &str| Files {
        project: file(&project, text),
        ..Files::default()
    };
    let is_refused = |result| matches!(result, Err(ConfigError::Outside { .. }));
    for key in ["pilot.maps", "region", "surface.mesh"] {
        for path in ["../maps", "maps/../../maps", outside.to_str().unwrap()] {
            let text = format!("{key} = '{path}'");
            assert!(is_refused(load(of_project(&text))), "{text}");
            let root = Files {
                root: file(&project, &text),
                ..Files::default()
            };
            assert!(is_refused(load(root)), "{text} of a watched folder");
            let user = Files {
                user: file(folder.path(), &text),
                ..Files::default()
            };
            assert!(load(user).is_ok(), "{text} of the user");
        }
        for path in ["maps", "../project/maps", "not/there/yet"] {
            let text = format!("{key} = '{path}'");
            assert!(load(of_project(&text)).is_ok(), "{text}");
        }
    }
    assert!(load(of_project("images = '../maps'\nregion = '0,0,0,1,1,1'")).is_ok());
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(&outside, project.join("link")).unwrap();
        assert!(is_refused(load(of_project("pilot.maps = 'link'"))));
        assert!(is_refused(load(of_project("region = 'link/area.json'"))));
    }
}

#[cfg(unix)]
#[test]
fn errors_quote_a_file_outside_only_if_the_user_names_it_by_no_link_of_the_project() {
    let folder = tempfile::tempdir().unwrap();
    let (project, outside) = (folder.path().join("project"), folder.path().join("sites"));
    fs::create_dir(&project).unwrap();
    fs::create_dir(&outside).unwrap();
    fs::write(outside.join("area"), "").unwrap();
    std::os::unix::fs::symlink(outside.join("area"), project.join("link")).unwrap();
    std::os::unix::fs::symlink(&outside, project.join("links")).unwrap();
    let text = |file: &Path| file.to_str().unwrap().to_owned();
    let quotes = |file: &Path, set: &dyn Fn(&mut CommandLineSettings)| {
        let mut typed = CommandLineSettings::default();
        set(&mut typed);
        let loaded = Configuration::load(&Files::default(), typed, canonical_name).unwrap();
        loaded.settings.may_quote(file, &project)
    };
    for (file, is_quoted) in [
        (outside.join("area"), true),
        (project.join("own"), true),
        (project.join("link"), false),
        (project.join("links/area"), false),
    ] {
        let by_user = quotes(&file, &|typed| {
            typed.set("--region", "region", Some(text(&file)))
        });
        assert_eq!(by_user, is_quoted, "{file:?}");
        let by_plan = quotes(&file, &|typed| {
            *typed = mem::take(typed).following(vec![planned("region", text(&file))]);
        });
        assert_eq!(by_plan, file == project.join("own"), "{file:?}");
    }
}

fn planned(key: &str, value: impl Into<Value>) -> TypedSetting {
    TypedSetting {
        key: key.into(),
        value: value.into(),
        instead_of: None,
    }
}

#[test]
fn options_of_the_last_plan_hold_until_one_is_typed_or_its_file_says_otherwise() {
    let plan = |project: &str| {
        let mut typed = CommandLineSettings::default();
        typed.set("-k", "partners.k", Some(8));
        typed.set("--gsd", "target.gsd", Some("2cm"));
        typed.set("--budget", "cut.budget", Some("7"));
        load("", project, typed).unwrap().settings.typed
    };
    let file = "units = 'metric'\npartners.k = 3\n";
    let run = |project: &str, typed: CommandLineSettings| {
        load("", project, typed.following(plan(file))).unwrap()
    };
    let same = run(file, CommandLineSettings::default());
    assert_eq!(same.settings.partners.k, 8);
    assert_eq!(same.settings.target.gsd, Some(0.02));
    let words: Vec<String> = same.followed().map(ToString::to_string).collect();
    assert_eq!(words, ["-k 8", "--gsd 2cm", "--budget 7"]);
    assert_eq!(
        same.settings.typed,
        plan(file),
        "and the next goes on from it"
    );

    let changed = run(
        "units = 'metric'\npartners.k = 4\n",
        CommandLineSettings::default(),
    );
    assert_eq!(changed.settings.partners.k, 4);
    assert_eq!(changed.settings.target.gsd, Some(0.02));

    let mut typed = CommandLineSettings::default();
    typed.set("-k", "partners.k", Some(5));
    typed.set("--target", "cut.target", Some("80%"));
    let typed = run(file, typed);
    assert_eq!(
        (typed.settings.partners.k, typed.settings.cut.budget),
        (5, None)
    );
    assert_eq!(typed.followed().count(), 1);
}

#[test]
fn of_a_forged_plan_only_options_of_plan_count() {
    let following = |key: &str, value: Value| {
        let typed = CommandLineSettings::default().following(vec![planned(key, value)]);
        load("", "", typed)
    };
    for key in ["on_target", "dispatch.setup", "no.such"] {
        let forged = following(key, "touch gone".into()).unwrap();
        assert_eq!(forged, Configuration::default(), "{key}");
    }
    let long = planned("region", "a/".repeat(3000));
    assert!(!long.is_of_plan() && planned("region", "a/b.ply").is_of_plan());
    let error = following("partners.k", "many".into()).unwrap_err();
    assert!(error.to_string().contains("-k of the last plan"), "{error}");
}

#[test]
fn a_path_of_the_last_plan_leads_out_as_one_of_the_projects_file_does() {
    let folder = tempfile::tempdir().unwrap();
    let project = folder.path().join("p");
    fs::create_dir(&project).unwrap();
    for (key, leads_out) in [
        ("region", true),
        ("surface.mesh", true),
        ("pilot.maps", true),
        ("images", false),
        ("ranking.scales", false),
    ] {
        let named = |path: &Path| planned(key, path.to_str().unwrap());
        assert_eq!(
            named(&folder.path().join("a")).leads_out(&project),
            leads_out,
            "{key}"
        );
        assert!(!named(&project.join("a")).leads_out(&project), "{key}");
    }
    for region in ["auto", "0,0,0,1,1,1"] {
        assert!(!planned("region", region).leads_out(&project), "{region}");
    }
}
