//! Tests that every config of the repository can be written in full, and that `flotilla check --expand` does.

use std::path::{Path, PathBuf};

use flotilla::config::{Config, GRID, VARY};
use flotilla_app::sweep::Sweep;

use crate::support::{Place, root};

/// Returns every config and sweep file of the repository.
fn files() -> Vec<PathBuf> {
    fn add(folder: &Path, files: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                add(&path, files);
            } else if path.extension().is_some_and(|extension| extension == "toml") {
                files.push(path);
            }
        }
    }
    let mut files = Vec::new();
    ["configs", "studies/configs"].iter().for_each(|folder| add(Path::new(&root(folder)), &mut files));
    files.sort();
    files
}

#[test]
fn every_config_can_be_written_in_full() {
    let (mut configs, mut sweeps) = (0, 0);
    for path in files() {
        let text = std::fs::read_to_string(&path).unwrap();
        let table: toml::Table = text.parse().unwrap();
        let config = if table.contains_key(GRID) || table.contains_key(VARY) {
            sweeps += 1;
            (*Sweep::load(&path, &[], true).unwrap().points[0].config).clone()
        } else {
            configs += 1;
            Config::load(&path).unwrap()
        };
        let name = path.display();
        let full =
            Config::parse(&config.expanded().to_toml(), "full.toml").unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(full, config.expanded(), "{name}");
        assert_eq!(full.classes(), config.classes(), "{name}");
        assert_eq!(full.population_of_each(), config.population_of_each(), "{name}");
        let has_both = !full.agents.is_empty() && !full.pois.is_empty();
        assert!(has_both || !config.stages.is_empty(), "{name}");
    }
    assert!(configs > 5 && sweeps > 1, "{configs} configs, {sweeps} sweeps");
}

#[test]
fn check_prints_a_config_in_full_and_nothing_else() {
    let chaotic = std::fs::read_to_string(root("configs/chaotic.toml")).unwrap();
    let keys = "paradigm = \"all-leaders\"\nsharing = \"group\" ";
    let grouped = chaotic.replace("paradigm = \"leader-follower\"", keys);
    let place = Place::new(&[("chaotic.toml", &chaotic), ("grouped.toml", &grouped)]);
    for name in ["chaotic.toml", "grouped.toml"] {
        let short = Config::load(&place.path(name)).unwrap();
        let (full, _) = place.good(&*format!("check --expand {name}"));
        assert_eq!(full, short.expanded().to_toml());
        assert_eq!(Config::parse(&full, "full.toml").unwrap().classes(), short.classes());
        // In full already, it is printed as it is.
        std::fs::write(place.path("full.toml"), &full).unwrap();
        assert_eq!(place.good("check --expand full.toml").0, full);
    }
    assert!(place.read("full.toml").contains("groups = [[0, 4, 5, 6, 7], [1, "));
    let seeded = place.good("check --expand chaotic.toml --seed 7").0;
    assert!(seeded.contains("seed = 7\n"));
    let refused = place.refused(2, "check full.toml --set world.coupling=2");
    assert!(refused.contains("to write a config in full, use `flotilla check --expand`"), "{refused}");
    let staged = format!("{chaotic}[[stages]]\nfrom = 3\nset = {{ \"world.coupling\" = 3 }}\n");
    std::fs::write(place.path("staged.toml"), staged).unwrap();
    let (full, noted) = place.good("check --expand staged.toml");
    assert!(full.contains("[[agents]]") && !full.contains("[[pois]]"), "{full}");
    assert!(noted.contains("[[pois]] is not written, because a stage sets a key that it would replace"), "{noted}");
}
