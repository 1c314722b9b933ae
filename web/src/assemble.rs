//! Builds the page: one self-contained file that needs no server and no network.
//!
//!     assemble WASM FOLDER
//!
//! `FOLDER/index.html` contains the style, the scripts, the paper's layouts, and the WebAssembly module, compressed and
//! encoded as text.

#[cfg(target_family = "wasm")]
fn main() {}

#[cfg(not(target_family = "wasm"))]
fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [wasm, folder] = &arguments[..] else {
        eprintln!("usage: assemble WASM FOLDER");
        std::process::exit(2);
    };
    if let Err(error) = page::make(wasm.as_ref(), folder.as_ref()) {
        eprintln!("error: {error}");
        std::process::exit(1);
    }
}

#[cfg(not(target_family = "wasm"))]
mod page {
    use std::error::Error;
    use std::fs;
    use std::path::Path;

    use base64::Engine;
    use base64::prelude::BASE64_STANDARD;
    use miniz_oxide::deflate::compress_to_vec_zlib;
    use wasm_bindgen_cli_support::Bindgen;

    /// Experiments of the gallery, by folder.
    const GALLERY: [(&str, &[&str]); 2] = [
        ("gallery", &["two_groups", "blind", "eight_followers", "relay", "places", "swarm"]),
        ("../configs", &["rovers"]),
    ];
    const LAYOUTS: [&str; 3] = ["generally_forward", "strictly_forward", "chaotic"];

    fn source(name: &str) -> Result<String, Box<dyn Error>> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(name);
        fs::read_to_string(&path).map_err(|error| format!("{}: cannot be read: {error}", path.display()).into())
    }

    /// The page's script: each module once, after those that it imports.
    #[derive(Default)]
    struct Script {
        text: String,
        joined: Vec<String>,
        /// The modules whose imports are being joined, each imported by the one before it.
        importing: Vec<String>,
    }

    impl Script {
        /// Joins a module, without its imports and exports. Names are unique among modules; the browser reports any
        /// that are not.
        fn join(&mut self, module: &str) -> Result<(), Box<dyn Error>> {
            if self.joined.iter().any(|joined| joined == module) {
                return Ok(());
            }
            if let Some(first) = self.importing.iter().position(|importing| importing == module) {
                let circle = self.importing[first..].join(", ");
                return Err(format!("web/page: these modules import each other in a circle: {circle}").into());
            }
            self.importing.push(module.into());
            let text = source(&format!("page/{module}.js"))?;
            let (imports, rest): (Vec<_>, Vec<_>) = text.lines().partition(|line| line.starts_with("import "));
            for import in imports {
                let file = import.split('"').nth(1).and_then(|file| file.strip_prefix("./")?.strip_suffix(".js"));
                self.join(file.ok_or_else(|| format!("{module}.js: imports no module of the page: {import}"))?)?;
            }
            for line in rest {
                self.text += &format!("{}\n", line.strip_prefix("export ").unwrap_or(line));
            }
            self.joined.extend(self.importing.pop());
            Ok(())
        }
    }

    /// Returns elements that hold texts for the script.
    fn inert(texts: &[(String, String)]) -> Result<String, String> {
        let mut elements = String::new();
        for (name, text) in texts {
            if text.contains("</") && text.to_lowercase().contains("</script") {
                return Err(format!("{name} would end its element early"));
            }
            elements += &format!("<script type=\"text/plain\" id=\"{name}\">{text}</script>\n");
        }
        Ok(elements)
    }

    pub fn make(wasm: &Path, folder: &Path) -> Result<(), Box<dyn Error>> {
        let mut made = Bindgen::new()
            .input_path(wasm)
            .no_modules(true)?
            .typescript(false)
            .remove_name_section(true)
            .remove_producers_section(true)
            .generate_output()?;
        let glue = made.js().to_string();
        let wasm = made.wasm_mut().emit_wasm();
        let packed = compress_to_vec_zlib(&wasm, 10);
        let worker = format!("{glue}\n{}", source("page/worker.js")?);
        let module = [("wasm".to_string(), BASE64_STANDARD.encode(&packed)), ("worker".to_string(), worker)];
        let mut texts = Vec::new();
        for layout in LAYOUTS {
            texts.push((format!("layout-{layout}"), source(&format!("../configs/{layout}.toml"))?));
        }
        for (folder, names) in GALLERY {
            for name in names {
                texts.push((format!("gallery-{name}"), source(&format!("{folder}/{name}.toml"))?));
            }
        }
        texts.push(("opening".into(), source("page/opening.json")?));
        let mut script = Script { text: source("../app/src/report/stage.js")?, ..Script::default() };
        script.join("main")?;
        let mut page = source("page/index.html")?;
        page = page.replacen("/* STYLE */", &source("page/style.css")?, 1).replacen("/* SCRIPTS */", &script.text, 1);
        // The script precedes the module, which is most of the page, so that the opening moves while the module arrives.
        page = page.replacen("<!-- TEXTS -->", &inert(&texts)?, 1).replacen("<!-- MODULE -->", &inert(&module)?, 1);
        fs::create_dir_all(folder)?;
        fs::write(folder.join("index.html"), &page)?;
        let all = compress_to_vec_zlib(page.as_bytes(), 9).len();
        println!(
            "{}: {} KB, {} KB compressed ({} KB of WebAssembly, {} KB compressed)",
            folder.join("index.html").display(),
            page.len() / 1000,
            all / 1000,
            wasm.len() / 1000,
            packed.len() / 1000
        );
        Ok(())
    }
}
