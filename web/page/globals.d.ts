// What the build puts before the modules: src/report/stage.js, which every page that shows episodes shares.
declare const stage: any;
interface Window { page: any }
// Browsers that can suspend WebAssembly have these.
declare namespace WebAssembly { const Suspending: any, promising: any }
interface Navigator { gpu: any }
