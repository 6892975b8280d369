// The pages in a headless browser: no error, no request, no violation of axe, at three widths, in both colours; and what the script
// does. Prints the size of each page, and how long the program and the browser take.
//
//     CKPT_DOCTOR=target/release/ckpt-doctor node tests/browser/pages.mjs FOLDER [SCREENSHOTS]
//
// FOLDER has the node_modules of package.json. Screenshots are written when the third argument names a folder.

import { execFileSync } from "node:child_process";
import fs from "node:fs";
import { createRequire } from "node:module";
import os from "node:os";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [folder, shots] = process.argv.slice(2);
const require = createRequire(path.join(path.resolve(folder), "package.json"));
const load = async (name) => (await import(pathToFileURL(require.resolve(name)))).default;
const [puppeteer, chromium] = [await load("puppeteer-core"), await load("@sparticuz/chromium")];
const axe = fs.readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const program = path.resolve(process.env.CKPT_DOCTOR);
const root = path.resolve(import.meta.dirname, "../..");
const work = fs.mkdtempSync(path.join(os.tmpdir(), "pages-"));
const WIDTHS = [390, 1024, 1920];
const LIMIT = 5_000_000;

const failures = [];
const expect = (holds, what) => holds || failures.push(what);

// A file of tensors whose data is a hole.
function sparse(dir, tensors) {
  fs.mkdirSync(dir);
  const header = { __metadata__: { format: "pt" } };
  let at = 0;
  for (const [name, shape] of tensors) {
    const end = at + 2 * shape.reduce((product, size) => product * size, 1);
    header[name] = { dtype: "BF16", shape, data_offsets: [at, end] };
    at = end;
  }
  const text = Buffer.from(JSON.stringify(header));
  const length = Buffer.alloc(8);
  length.writeBigUInt64LE(BigInt(text.length));
  const file = path.join(dir, "model.safetensors");
  fs.writeFileSync(file, Buffer.concat([length, text]));
  fs.truncateSync(file, 8 + text.length + at);
}

function llama(dir) {
  const config = {
    architectures: ["LlamaForCausalLM"], model_type: "llama", vocab_size: 32000, hidden_size: 4096, intermediate_size: 11008,
    num_hidden_layers: 32, num_attention_heads: 32, num_key_value_heads: 32, torch_dtype: "bfloat16", transformers_version: "4.47.0",
  };
  const alone = path.join(work, "config.json");
  fs.writeFileSync(alone, JSON.stringify(config));
  const [expected] = JSON.parse(execFileSync(program, ["expect", alone, "--output-format", "json"], { maxBuffer: 1 << 28 }));
  sparse(dir, Object.entries(expected.tensors));
  fs.copyFileSync(alone, path.join(dir, "config.json"));
}

// 90 000 tensors of which hardly two are alike, so that nothing is folded.
function many(dir) {
  const name = (at) => `model.layers.${Math.floor(at / 1500)}.mlp.experts.${at % 1500}.weight`;
  sparse(dir, Array.from({ length: 90_000 }, (_, at) => [name(at), [1 + ((at * 7919) % 13)]]));
}

// A copy with other bytes at the end of each file.
function tuned(dir, from) {
  fs.cpSync(from, dir, { recursive: true });
  for (const file of fs.readdirSync(dir).filter((name) => name.endsWith(".safetensors"))) {
    const place = path.join(dir, file);
    fs.chmodSync(place, 0o644);
    const bytes = fs.readFileSync(place);
    bytes[bytes.length - 2] ^= 0x10;
    fs.writeFileSync(place, bytes);
  }
}

const at = (name) => path.join(work, name);
const donor = (name) => path.join(root, "fixtures/donors", name);
llama(at("llama-7b"));
many(at("many"));
tuned(at("tuned"), donor("llava3d-tiny"));
const zoo = Array.from({ length: 23 }, (_, number) => at(`model-${number}`));
zoo.forEach((dir, number) => fs.cpSync(donor(number % 2 ? "spatialvla-tiny" : "llava3d-tiny"), dir, { recursive: true }));
fs.rmSync(path.join(zoo[0], "model.safetensors.index.json"));
const pages = {
  zoo: ["check", donor("spatialvla-tiny"), donor("llava3d-tiny"), at("llama-7b"), ...zoo, "--exit-zero"],
  finding: ["check", at("tuned"), "--exit-zero"],
  "llama-7b": ["inspect", at("llama-7b")],
  many: ["inspect", at("many")],
  diff: ["diff", donor("llava3d-tiny"), at("tuned"), "--stats"],
  merge: ["merge", path.join(root, "fixtures/merge.json5"), "--out", at("merged")],
};
const config = path.join(at("tuned"), "config.json");
fs.writeFileSync(config, fs.readFileSync(config, "utf8").replace('"vocab_size": 340', '"vocab_size": 341'));

const browser = await puppeteer.launch({
  executablePath: await chromium.executablePath(),
  args: [...puppeteer.defaultArgs({ args: chromium.args, headless: "shell" })],
  headless: "shell",
});
console.log("page          bytes  written in ms  shown in ms");
for (const [name, args] of Object.entries(pages)) {
  const file = at(`${name}.html`);
  let begun = performance.now();
  try {
    execFileSync(program, [...args, "--report", `html=${file}`], { stdio: ["ignore", "ignore", "pipe"], maxBuffer: 1 << 28 });
  } catch (error) {
    expect(name === "diff" && error.status === 1, `${name}: exit ${error.status}: ${error.stderr}`);
  }
  const written = performance.now() - begun;
  const size = fs.statSync(file).size;
  expect(size < LIMIT, `${name}: ${size} bytes`);
  const page = await browser.newPage();
  page.on("console", (message) => failures.push(`${name}: console: ${message.text()}`));
  page.on("pageerror", (error) => failures.push(`${name}: ${error}`));
  page.on("request", (request) => expect(request.url().startsWith("file:"), `${name}: asks for ${request.url()}`));
  let shown = 0;
  for (const width of WIDTHS) {
    await page.setViewport({ width, height: 1000 });
    begun = performance.now();
    await page.goto(pathToFileURL(file).href, { waitUntil: "load" });
    shown = Math.max(shown, performance.now() - begun);
    const wide = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    expect(wide <= 0, `${name}: ${wide} pixels wider than ${width}`);
    if (shots) await page.screenshot({ path: path.join(shots, `${name}-${width}.png`), fullPage: size < 400_000 });
  }
  await interact(page, name);
  for (const scheme of ["light", "dark"]) {
    await page.emulateMediaFeatures([{ name: "prefers-color-scheme", value: scheme }]);
    if (shots && scheme === "dark") await page.screenshot({ path: path.join(shots, `${name}-dark.png`) });
    // The policy of a page lets no other script run, so axe is evaluated by the driver.
    await page.evaluate(axe);
    const found = await page.evaluate(() => axe.run({ resultTypes: ["violations"] }));
    for (const one of found.violations) {
      failures.push(`${name}, ${scheme}: ${one.id}: ${one.help}: ${one.nodes.length} times, ${one.nodes[0].html.slice(0, 150)}`);
    }
  }
  await page.close();
  const cells = [String(size).padStart(9), written.toFixed(0).padStart(13), shown.toFixed(0).padStart(11)];
  console.log(name.padEnd(9), ...cells);
}
await browser.close();
fs.rmSync(work, { recursive: true });
for (const failure of failures.slice(0, 40)) console.log(`FAILED ${failure}`);
console.log(`${Object.keys(pages).length} pages, ${failures.length} failures`);
process.exit(failures.length ? 1 : 0);

// What the script of a page does.
async function interact(page, name) {
  const count = (selector) => page.$$eval(selector, (all) => all.filter((one) => one.offsetWidth > 0).length);
  if (name === "zoo") {
    const rows = await count("#models tbody tr");
    expect(rows === 26, `zoo: ${rows} rows`);
    await page.type("input[type=search]", "llama-7b");
    expect((await count("#models tbody tr")) === 1, "zoo: the search shows other rows");
    expect((await count("section")) === 1, "zoo: the search shows other sections");
    expect((await page.$eval("output", (one) => one.textContent)) === "1 of 26", "zoo: the search counts otherwise");
    await page.$eval("input[type=search]", (one) => {
      one.value = "";
      one.dispatchEvent(new Event("input"));
    });
    await page.click("input[type=checkbox]");
    const failing = await count("#models tbody tr");
    expect(failing < 26, "zoo: the rows without findings are shown");
    await page.click("input[type=checkbox]");
    await page.keyboard.press("Tab");
    return;
  }
  if (!(await page.$(".map"))) return;
  const [before, whole] = [await count(".map .tile"), await page.$eval(".map", (map) => map.offsetWidth)];
  const tile = await page.$(".map .tile .tile:nth-child(2)");
  await (await tile.$("span")).click();
  const width = await tile.evaluate((one) => one.offsetWidth);
  expect(width >= whole - 2, `${name}: a chosen module is ${width} of ${whole} pixels wide`);
  expect((await count("button[data-back]")) === 1, `${name}: no way back`);
  await page.keyboard.press("Escape");
  expect((await count(".map .tile")) === before, `${name}: Escape does not show the whole model`);
  const paint = () => page.$eval(".map .tile span", (one) => getComputedStyle(one).background);
  const first = await paint();
  const radios = await page.$$("fieldset input");
  await radios[1].click();
  // The others have one type, and one colour by it.
  if (name === "merge") expect((await paint()) !== first, "merge: another property has the same colours");
  await page.click("details.tree > summary");
  expect((await count("details.tree > .leaf, details.tree > details")) > 0, `${name}: the list does not open`);
}
