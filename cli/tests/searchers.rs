//! Tests the study of followers and populations, `flotilla paper --populations`.

use crate::support::Place;

/// Returns the rows of a table of comma-separated values. Quoted cells may have commas.
fn rows(place: &Place, name: &str) -> Vec<Vec<String>> {
    let text = place.bytes(name);
    let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(&text[..]);
    reader.records().map(|row| row.unwrap().iter().map(String::from).collect()).collect()
}

#[test]
fn contrasts_are_differences_of_cells_over_pairs() {
    let place = Place::new(&[]).on_cpu();
    let line = "paper --populations=strictly-forward --trials 3 --generations 2 --set learning.population=40 \
                --set world.coupling=1 --out study --quiet";
    place.good(line);
    let (cells, pairs) = (rows(&place, "study/cells.csv"), rows(&place, "study/pairs.csv"));
    // Three arms without followers have two fitnesses, two with followers have three; each twice by speed and density.
    assert_eq!((cells.len() - 1, place.path("study/arms").read_dir().unwrap().count()), (12 * 4 * 3, 12 * 4));
    // Of five contrasts, one is between arms with followers, which alone have Df. D is compared with G in all arms, Df in two.
    assert_eq!(pairs.len() - 1, (5 * 2 + 1 + 5 + 2) * 4 * 3);
    let value = |row: &[String]| row[6].parse::<f64>().unwrap();
    let arms = |what: &str| match what.split(' ').next().unwrap() {
        "fewer" => ["no followers, one per group", "no followers, a population per agent"],
        "followers," if what.contains("per group") => ["followers, one per leader", "no followers, one per group"],
        "followers," => ["followers, one for all", "no followers, one for all"],
        "one" => ["followers, one for all", "followers, one per leader"],
        _ => ["followers, one per leader", "no followers, a population per agent"],
    };
    let mut differ = 0;
    for row in &pairs[1..] {
        let g = |arm: &str, fitness: &str| {
            let is = |cell: &&Vec<String>| {
                (&*cell[1], &*cell[4]) == (fitness, arm)
                    && [0, 2, 3, 5].iter().all(|&column| cell[column] == row[column])
            };
            value(cells.iter().find(is).unwrap_or_else(|| panic!("{row:?}: {arm}")))
        };
        let [one, other] = match row[4].split_once(" instead of G: ") {
            Some((fitness, arm)) => [g(arm, fitness), g(arm, "G")],
            None => arms(&row[4]).map(|arm| g(arm, &row[1])),
        };
        assert!((one - other - value(row)).abs() < 2e-4, "{row:?}: {one} and {other}");
        differ += usize::from(one != other);
    }
    assert!(differ > 10, "only {differ} contrasts are not 0");
    let before = place.bytes("study/cells.csv");
    place.fails(1, line, &["study"]);
    place.good(&format!("{line} --resume"));
    assert_eq!(place.bytes("study/cells.csv"), before);
    assert!(place.path("study/populations.svg").is_file());
    place.fails(2, "paper --populations=nowhere --out other", &["generally-forward"]);
}
