//! Text tables: Markdown for terminals and pages, and LaTeX.

use std::fmt::Write;

/// Returns a Markdown table with aligned columns. The first row is the head. A `|` in a cell is escaped.
pub fn markdown(rows: &[Vec<String>]) -> String {
    let escaped = |row: &Vec<String>| row.iter().map(|cell| cell.replace('|', r"\|")).collect();
    let rows: Vec<Vec<String>> = rows.iter().map(escaped).collect();
    let columns = rows[0].len();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &[String]| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, &width)| format!("{cell:width$}")).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let rule = line(&widths.iter().map(|&width| "-".repeat(width)).collect::<Vec<_>>());
    let (head, body) = (line(&rows[0]), rows[1..].iter().map(|row| line(row)));
    std::iter::once(head).chain([rule]).chain(body).collect()
}

/// Returns a LaTeX `tabular` that needs no package. The first row is the head. Columns of numbers are right-aligned.
pub(crate) fn latex(rows: &[Vec<String>]) -> String {
    let is_number = |cell: &String| cell.starts_with(|c: char| c.is_ascii_digit() || "+−<".contains(c));
    let place = |column: usize| if rows[1..].iter().all(|row| is_number(&row[column])) { 'r' } else { 'l' };
    let places: String = (0..rows[0].len()).map(place).collect();
    let mut text = format!("\\begin{{tabular}}{{{places}}}\n\\hline\n");
    for (at, row) in rows.iter().enumerate() {
        let cells: Vec<String> = row.iter().map(|cell| tex(cell)).collect();
        let _ = writeln!(text, "{} \\\\{}", cells.join(" & "), if at == 0 { " \\hline" } else { "" });
    }
    text + "\\hline\n\\end{tabular}\n"
}

/// Escapes a text for LaTeX, so that nothing in it is a command.
pub(crate) fn tex(text: &str) -> String {
    let escaped = |c: char| match c {
        '\\' => "\\textbackslash{}".into(),
        '~' => "\\textasciitilde{}".into(),
        '^' => "\\textasciicircum{}".into(),
        '#' | '$' | '%' | '&' | '_' | '{' | '}' => format!("\\{c}"),
        '−' => "$-$".into(),
        '<' | '>' | '|' => format!("${c}$"),
        _ => c.to_string(),
    };
    // LaTeX would read a bracket or star at the start of a row as part of the preceding line break.
    let guard = if text.starts_with(['[', '*']) { "{}" } else { "" };
    guard.chars().map(String::from).chain(text.chars().map(escaped)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_in_a_cell_is_no_command() {
        let rows = [["arm", "G"], ["at % of_#1 & {x}^~$\\", "−0.50 [0, 1]"]];
        let rows = rows.map(|row| row.map(String::from).to_vec());
        assert_eq!(
            latex(&rows),
            "\\begin{tabular}{lr}\n\\hline\narm & G \\\\ \\hline\nat \\% of\\_\\#1 \\& \\{x\\}\\textasciicircum{}\\textasciitilde{}\\$\
             \\textbackslash{} & $-$0.50 [0, 1] \\\\\n\\hline\n\\end{tabular}\n"
        );
        assert_eq!(tex("[a]"), "{}[a]");
        assert_eq!(markdown(&rows[..1]), "| arm | G |\n| --- | - |\n");
        assert_eq!(markdown(&[vec!["a|b".into(), "G".into()]]), "| a\\|b | G |\n| ---- | - |\n");
    }
}
