"use strict";
/* The page of the 3D viewer: survey shown, colours, swipe, table, links. The points: point_octree.js. */
(function () {
  const byId = (id) => document.getElementById(id), PAGE = 100;
  const COLOURS = ["change", "class", "height", "intensity", "confidence", "survey"];
  const EDL_FRAGMENT = `
    uniform sampler2D uImage, uDepth; uniform vec2 uPixel, uRange; in vec2 vUv; layout(location = 0) out vec4 pixel;
    float reach(vec2 uv) { float d = texture(uDepth, uv).r; if (d >= 1.0) { return -1.0; } return log2(uRange.x * uRange.y / (uRange.y - d * (uRange.y - uRange.x))); }
    void main() {
      float own = reach(vUv); vec3 colour = texture(uImage, vUv).rgb;
      if (own < 0.0) { pixel = vec4(0.063, 0.086, 0.114, 1.0); return; }
      float sum = 0.0;
      for (int k = 0; k < 8; k += 1) {
        float turn = 0.7853982 * float(k), other = reach(vUv + 1.4 * uPixel * vec2(cos(turn), sin(turn)));
        if (other >= 0.0) { sum += max(0.0, own - other); } else { sum += 0.02; }
      }
      pixel = vec4(colour * exp(-min(sum / 8.0 * 120.0, 1.1)), 1.0);
    }`;
  let D, R, renderer, points, camera, controls, target, post, postScene, outline, uniforms, due = 0, flight = null;
  let mode = "both", swipe = 0.5, chosen = -1, order = [], page = 0, last = null, at = new Map(), hiddenLabels = new Set(), hiddenClasses = new Set();

  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  }
  function fail(text) { byId("status").textContent = text; document.documentElement.setAttribute("data-failed", text); }
  function escape(text) { return String(text).replace(/[&<>"']/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#39;" }[c])); }
  function number(value, decimals) { return value === null || value === undefined ? "–" : value.toFixed(decimals).replace(/^-(?=[0.]*$)/, ""); }
  function millions(count) { return count >= 1e6 ? (count / 1e6).toFixed(1) + " million" : Math.round(count / 1e3) + " thousand"; }
  function rgb(text) { return text.match(/\d+/g).map(Number); }
  function tone(entry) { return byId("safe").checked && entry.safe ? entry.safe : entry.colour; }

  function table(entries, hidden) {
    const bytes = new Uint8Array(256 * 4).fill(255);
    entries.forEach((entry) => { bytes.set([...rgb(tone(entry)), hidden.has(entry.label) ? 0 : 255], 4 * entry.code); });
    return bytes;
  }
  function texture(bytes) {
    const made = new THREE.DataTexture(bytes, 256, 1, THREE.RGBAFormat, THREE.UnsignedByteType);
    made.needsUpdate = true;
    return made;
  }
  function recolour() {
    uniforms.uChange.value.image.data.set(table(D.labels, hiddenLabels)); uniforms.uChange.value.needsUpdate = true;
    uniforms.uClass.value.image.data.set(table(D.classes, hiddenClasses)); uniforms.uClass.value.needsUpdate = true;
    uniforms.uColour.value = COLOURS.indexOf(byId("colour").value);
    legend(); list(); draw();
  }
  function ramp() { const bytes = new Uint8Array(1024); for (let i = 0; i < 256; i += 1) { bytes.set([...D.ramp.slice(3 * i, 3 * i + 3), 255], 4 * i); } return bytes; }

  // drawing: only when something changed
  function shownIn(part) { return { before: ["before"], after: ["after"], swipe: [part], both: ["before", "after"] }[mode]; }
  function draw() { if (!due) { due = requestAnimationFrame(drawNow); } }
  function drawNow(time) {
    due = 0;
    if (flight) { fly(time); }
    const near = camera.position.distanceTo(controls.target);
    camera.near = Math.max(near / 200, 0.05); camera.far = near + 4 * D.size; camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    const wide = target.width, high = target.height, border = Math.round(swipe * wide);
    points.update(camera, mode === "swipe" ? ["before", "after"] : shownIn(), high);
    renderer.setRenderTarget(target);
    target.scissorTest = false; renderer.clear();
    if (mode === "swipe") {
      target.scissorTest = true;  // three.js takes the scissor up when the target is set
      target.scissor.set(0, 0, border, high); renderer.setRenderTarget(target); renderer.render(points.octrees.before.scene, camera);
      target.scissor.set(border, 0, wide - border, high); renderer.setRenderTarget(target); renderer.render(points.octrees.after.scene, camera);
      target.scissorTest = false; renderer.setRenderTarget(target);
    } else { shownIn().forEach((name) => renderer.render(points.octrees[name].scene, camera)); }
    renderer.setRenderTarget(null); renderer.clear();
    post.uniforms.uRange.value.set(camera.near, camera.far);
    renderer.render(postScene, camera);
    renderer.render(outline, camera);
    byId("status").textContent = (points.settled ? "" : "loading … ") + millions(points.drawnPoints) + " points drawn" + (points.missing ? "; " + points.missing + " pieces of the clouds could not be loaded: copy the folder viewer whole" : "");
    if (points.settled && !flight) { document.documentElement.setAttribute("data-ready", String(points.drawnPoints)); } else { document.documentElement.removeAttribute("data-ready"); }
    if (flight) { draw(); }
  }
  function fit() {
    const stage = byId("stage"), dot = Math.min(window.devicePixelRatio || 1, 2), wide = Math.max(stage.clientWidth, 1), high = Math.max(stage.clientHeight, 1);
    renderer.setPixelRatio(dot); renderer.setSize(wide, high, false);
    target.setSize(Math.round(wide * dot), Math.round(high * dot));
    post.uniforms.uPixel.value.set(1 / target.width, 1 / target.height);
    camera.aspect = wide / high; camera.updateProjectionMatrix(); placeSwipe(); draw();
  }

  // camera
  function fly(time) {
    if (flight.begun === null) { flight.begun = time; }
    const share = Math.min((time - flight.begun) / flight.duration, 1), eased = share * share * (3 - 2 * share);
    camera.position.lerpVectors(flight.from, flight.to, eased); controls.target.lerpVectors(flight.aimFrom, flight.aimTo, eased);
    if (share >= 1) { flight = null; }
    controls.update();
  }
  function flyTo(position, aim, duration) {
    flight = { from: camera.position.clone(), to: position, aimFrom: controls.target.clone(), aimTo: aim, begun: null, duration: Math.max(duration, 1) };
    draw();
  }
  function wholeBox() {
    const found = new THREE.Box3();
    Object.values(D.clouds).forEach((cloud) => cloud.box && found.union(new THREE.Box3(new THREE.Vector3(...cloud.box[0]), new THREE.Vector3(...cloud.box[1]))));
    return found;
  }
  function lookAt(box, direction, least, duration) {
    const aim = box.getCenter(new THREE.Vector3()), radius = Math.max(box.getSize(new THREE.Vector3()).length() / 2, least);
    const away = radius / Math.sin(THREE.MathUtils.degToRad(camera.fov / 2)) / Math.min(camera.aspect, 1) * (least > 4 ? 0.62 : 1.15);
    flyTo(aim.clone().addScaledVector(direction.normalize(), away), aim, duration);
  }
  const SOUTH = () => new THREE.Vector3(-0.35, -1, 0.9), ABOVE = () => new THREE.Vector3(0, -1e-4, 1);
  function rowBox(i) { const b = R.box[i]; return new THREE.Box3(new THREE.Vector3(b[0], b[1], b[2]), new THREE.Vector3(b[3], b[4], b[5])); }

  // the row chosen
  function choose(i, moves) {
    chosen = i; uniforms.uSelected.value = i < 0 ? 0 : R.object_id[i] + 1;
    outline.clear();
    if (i >= 0) {
      const box = rowBox(i).expandByScalar(0.15), c = [box.min, box.max], lines = [];
      for (let k = 0; k < 8; k += 1) {
        for (const bit of [1, 2, 4]) { if (!(k & bit)) { for (const j of [k, k | bit]) { lines.push(c[j & 1].x, c[j >> 1 & 1].y, c[j >> 2 & 1].z); } } }
      }
      const shape = new THREE.BufferGeometry();
      shape.setAttribute("position", new THREE.BufferAttribute(new Float32Array(lines), 3));
      outline.add(new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: "#ffe14d", depthTest: false })));
      const place = order.indexOf(i);
      if (place < 0) { byId("f-label").value = byId("f-class").value = byId("f-text").value = ""; filter(); }
      page = Math.floor(Math.max(order.indexOf(i), 0) / PAGE);
      if (moves) { lookAt(rowBox(i), SOUTH(), 4, 500); }
      byId("report").href = "../report.html#object-" + R.object_id[i];
      history.replaceState(null, "", "#object-" + R.object_id[i]);
    }
    list(); card(null); draw();
    const line = byId("rows").querySelector("[aria-selected=true]");
    if (line) { line.scrollIntoView({ block: "nearest" }); }
  }
  function world(at) { return at.map((value, k) => value + D.corner[k]); }
  function labelOf(code) { const found = D.labels.find((entry) => entry.code === code); return found ? found.label : String(code); }
  function classOf(code) { const found = D.classes.find((entry) => entry.code === code); return found ? found.label : String(code); }
  function card(point) {
    const box = byId("card"), i = chosen;
    if (!point && i < 0) { box.hidden = true; return; }
    let html = '<button type="button" class="close" aria-label="Close">×</button>';
    if (i >= 0) {
      html += "<h2>" + sign(R.label[i]) + " Object " + R.object_id[i] + ": " + escape(R.label[i]) + " " + escape(R["class"][i]) + "</h2><p>" + escape(R.reason[i]) + "</p><dl><dt>Confidence</dt><dd>" + number(R.confidence[i], 2) + "</dd><dt>Change of height</dt><dd>" + number(R.delta_h_m[i], 2) + " m</dd><dt>Change of volume</dt><dd>" + number(R.delta_v_m3[i], 1) + ' m³</dd></dl><p><a href="../report.html#object-' + R.object_id[i] + '">Row in the report</a></p>';
    }
    if (point) {
      html += (i < 0 ? "<h2>Point of the survey " + point.survey + "</h2>" : "<p>Point of the survey " + point.survey + "</p>") + "<dl><dt>Label</dt><dd>" + labelOf(point.change) + "</dd><dt>Class</dt><dd>" + classOf(point.kind) + "</dd><dt>Coordinates</dt><dd>" + world(point.at).map((v) => v.toFixed(2)).join(", ") + (D.crs ? " (" + escape(D.crs) + ")" : "") + "</dd>";
      if (last) {
        const d = point.at.map((v, k) => v - last[k]);
        html += "<dt>From the last point</dt><dd>" + Math.hypot(...d).toFixed(2) + " m, of it " + Math.hypot(d[0], d[1]).toFixed(2) + " m level and " + d[2].toFixed(2) + " m up</dd>";
      }
      html += "</dl>";
      last = point.at;
    }
    box.innerHTML = html; box.hidden = false;
    box.querySelector(".close").addEventListener("click", () => { choose(-1, false); history.replaceState(null, "", location.pathname + location.search); });
  }
  function clickAt(x, y) {
    const stage = byId("view").getBoundingClientRect(), part = x / stage.width < swipe ? "before" : "after";
    const found = points.pick(camera, shownIn(part), x, y, stage.width, stage.height, 6);
    if (!found) { return null; }
    const row = found.object >= 0 ? at.get(found.object) : undefined;
    choose(row === undefined ? -1 : row, false);
    card(found);
    return found;
  }

  // the table
  function sign(label) { const entry = D.labels.find((e) => e.label === label); return '<span class="sign" style="background:' + tone(entry) + '">' + entry.sign + "</span>"; }
  function filter() {
    const label = byId("f-label").value, kind = byId("f-class").value, query = byId("f-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    order = R.object_id.map((_, i) => i).filter((i) => (label === "" || (label === "changed" ? D.changed.includes(R.label[i]) : R.label[i] === label)) && (kind === "" || R["class"][i] === kind) &&
      query.every((word) => /^\d+$/.test(word) ? String(R.object_id[i]) === word : (R.label[i] + " " + R["class"][i] + " " + R.reason[i]).toLowerCase().includes(word)));
    page = 0; list();
  }
  function list() {
    const pages = Math.max(Math.ceil(order.length / PAGE), 1);
    byId("rows").innerHTML = order.slice(page * PAGE, (page + 1) * PAGE).map((i) => '<div class="row' + (R.review[i] === "rejected" ? " rejected" : "") + '" role="option" data-i="' + i + '" aria-selected="' + (i === chosen) + '">' + sign(R.label[i]) + " <b>" + R.object_id[i] + "</b> " + escape(R.label[i]) + " " + escape(R["class"][i]) + '<div class="small">Δh ' + number(R.delta_h_m[i], 2) + " m, ΔV " + number(R.delta_v_m3[i], 1) + " m³, confidence " + number(R.confidence[i], 2) + "</div></div>").join("");
    byId("count").textContent = order.length + " of " + R.object_id.length + " rows" + (D.left_out ? "; " + D.left_out + " unchanged or undecided rows are in changes.csv" : "") + ". Click a row to fly there.";
    byId("page").textContent = "page " + (page + 1) + " of " + pages;
    byId("previous").disabled = page === 0; byId("next").disabled = page + 1 >= pages;
  }

  // legend and modes
  function legend() {
    const colour = byId("colour").value, check = (entry, hidden, mark) => '<label><input type="checkbox" data-label="' + entry.label + '"' + (hidden.has(entry.label) ? "" : " checked") + ">" + mark + entry.label + "</label>";
    const labels = D.labels.map((entry) => check(entry, hiddenLabels, colour === "change" ? sign(entry.label) : "")).join(""), swatch = (c) => '<span class="sign" style="background:' + c + '"></span>';
    let html = labels;
    if (colour === "class") { html = D.classes.map((entry) => check(entry, hiddenClasses, swatch(entry.colour))).join(""); }
    if (colour === "survey") { html = "<div>" + swatch("#e69f00") + " before</div><div>" + swatch("#56b4e9") + " after</div>" + labels; }
    const steps = Array.from({ length: 9 }, (_, k) => "rgb(" + D.ramp.slice(3 * Math.min(32 * k, 255), 3 * Math.min(32 * k, 255) + 3).join() + ")").join();
    const ends = { height: [(uniforms.uHeights.value.x + D.corner[2]).toFixed(1) + " m", (uniforms.uHeights.value.x + uniforms.uHeights.value.y + D.corner[2]).toFixed(1) + " m"], confidence: ["0", "1"], intensity: ["weak", "strong"] }[colour];
    if (ends) { html = '<div class="ramp" style="background:linear-gradient(90deg,' + (colour === "intensity" ? "#1a1a1a,#fff" : steps) + ')"></div><div class="ends"><span>' + ends[0] + "</span><span>" + ends[1] + "</span></div>" + labels; }
    byId("legend-entries").innerHTML = html;
  }
  function setMode(name) {
    mode = name;
    document.querySelectorAll("[data-mode]").forEach((button) => button.setAttribute("aria-pressed", String(button.dataset.mode === mode)));
    const day = (epoch) => (epoch === "before" ? "Before" : "After") + (D.days[epoch] ? ", " + D.days[epoch] : "");
    byId("date-left").textContent = mode === "after" ? day("after") : mode === "both" ? "" : day("before");
    byId("date-right").textContent = mode === "swipe" ? day("after") : "";
    byId("swipe").hidden = mode !== "swipe"; placeSwipe(); draw();
  }
  function placeSwipe() { const bar = byId("swipe"); bar.style.left = 100 * swipe + "%"; bar.setAttribute("aria-valuenow", String(Math.round(100 * swipe))); }
  function setSwipe(share) { swipe = Math.min(Math.max(share, 0), 1); placeSwipe(); draw(); }
  function link() {
    const view = [...camera.position.toArray(), ...controls.target.toArray()].map((v) => v.toFixed(2)).join(",");
    return location.href.split("#")[0] + "#" + (chosen >= 0 ? "object-" + R.object_id[chosen] + "&" : "") + "mode=" + mode + "&colour=" + byId("colour").value + "&swipe=" + Math.round(100 * swipe) + "&view=" + view;
  }
  function follow(first) {
    const said = new Map(), parts = decodeURIComponent(location.hash.slice(1)).split("&").filter(Boolean);
    parts.forEach((part) => { const [key, value] = part.split("="); said.set(key, value); });
    if (["before", "after", "swipe", "both"].includes(said.get("mode"))) { setMode(said.get("mode")); }
    if (COLOURS.includes(said.get("colour"))) { byId("colour").value = said.get("colour"); recolour(); }
    if (said.has("swipe")) { setSwipe(Number(said.get("swipe")) / 100 || 0); }
    const view = (said.get("view") || "").split(",").map(Number), named = parts.find((part) => part.startsWith("object-")), i = named ? at.get(Number(named.slice(7))) : undefined;
    if (i !== undefined && i !== chosen) { choose(i, view.length !== 6); }
    if (view.length === 6 && view.every(Number.isFinite)) { flyTo(new THREE.Vector3(...view.slice(0, 3)), new THREE.Vector3(...view.slice(3)), first ? 1 : 400); }
    else if (first && i === undefined) { lookAt(wholeBox(), SOUTH(), 5, 1); }
  }
  function copy(text, button) {
    const was = button.textContent, done = () => { button.textContent = "Copied"; setTimeout(() => { button.textContent = was; }, 1200); };
    const fallback = () => { const box = document.createElement("textarea"); box.value = text; document.body.appendChild(box); box.select(); document.execCommand("copy"); box.remove(); done(); };
    if (navigator.clipboard) { navigator.clipboard.writeText(text).then(done, fallback); } else { fallback(); }
  }

  function build() {
    const canvas = byId("view");
    try { renderer = new THREE.WebGLRenderer({ canvas: canvas, antialias: false, powerPreference: "high-performance" }); } catch (error) { fail("This browser shows no 3D graphics (WebGL 2). The table beside it works; pictures are in report.html."); return false; }
    THREE.ColorManagement.enabled = false; renderer.autoClear = false; renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    target = new THREE.WebGLRenderTarget(4, 4, { depthTexture: new THREE.DepthTexture(4, 4, THREE.UnsignedIntType), minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter });
    camera = new THREE.PerspectiveCamera(50, 1, 0.1, 1000); camera.up.set(0, 0, 1); camera.position.set(0, -1, 1);
    controls = new THREE.MapControls(camera, canvas); controls.zoomToCursor = true; controls.enableDamping = false; controls.maxPolarAngle = 0.95 * Math.PI; controls.addEventListener("change", draw);
    const heights = Object.values(D.clouds).map((cloud) => cloud.heights), low = Math.min(...heights.map((h) => h[0])), high = Math.max(...heights.map((h) => h[1]));
    uniforms = { uScale: { value: 1 }, uFactor: { value: 1.2 }, uSelected: { value: 0 }, uColour: { value: 0 }, uHeights: { value: new THREE.Vector2(low, Math.max(high - low, 0.1)) },
      uChange: { value: texture(table(D.labels, hiddenLabels)) }, uClass: { value: texture(table(D.classes, hiddenClasses)) }, uRamp: { value: texture(ramp()) } };
    points = new Subiaco.PointScene(D, uniforms, draw);
    points.hidden = (change, kind) => hiddenLabels.has(labelOf(change)) || hiddenClasses.has(classOf(kind));
    outline = new THREE.Scene();
    post = new THREE.ShaderMaterial({ glslVersion: THREE.GLSL3, depthTest: false, depthWrite: false,
      uniforms: { uImage: { value: target.texture }, uDepth: { value: target.depthTexture }, uPixel: { value: new THREE.Vector2() }, uRange: { value: new THREE.Vector2() } },
      vertexShader: "out vec2 vUv; void main() { vUv = position.xy * 0.5 + 0.5; gl_Position = vec4(position.xy, 0.0, 1.0); }", fragmentShader: EDL_FRAGMENT });
    const screen = new THREE.BufferGeometry();
    screen.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    const sheet = new THREE.Mesh(screen, post); sheet.frustumCulled = false;
    postScene = new THREE.Scene(); postScene.add(sheet);
    return true;
  }
  function listen() {
    let down = null;
    const canvas = byId("view"), bar = byId("swipe");
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; flight = null; });
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4 && event.button === 0) { const box = canvas.getBoundingClientRect(); clickAt(event.clientX - box.left, event.clientY - box.top); }
      down = null;
    });
    bar.addEventListener("pointerdown", (event) => { bar.setPointerCapture(event.pointerId); event.preventDefault(); });
    bar.addEventListener("pointermove", (event) => { if (bar.hasPointerCapture(event.pointerId)) { const box = byId("stage").getBoundingClientRect(); setSwipe((event.clientX - box.left) / box.width); } });
    bar.addEventListener("keydown", (event) => { const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key]; if (step) { setSwipe(swipe + step); event.preventDefault(); } });
    document.querySelectorAll("[data-mode]").forEach((button) => button.addEventListener("click", () => setMode(button.dataset.mode)));
    byId("colour").addEventListener("input", recolour);
    byId("safe").addEventListener("input", recolour);
    byId("size").addEventListener("input", (event) => { uniforms.uFactor.value = Number(event.target.value); draw(); });
    byId("budget").addEventListener("input", (event) => { points.budget = Number(event.target.value); draw(); });
    byId("legend").addEventListener("input", (event) => {
      const hidden = byId("colour").value === "class" ? hiddenClasses : hiddenLabels, label = event.target.dataset.label;
      if (event.target.checked) { hidden.delete(label); } else { hidden.add(label); }
      recolour();
    });
    byId("home").addEventListener("click", () => lookAt(wholeBox(), SOUTH(), 5, 500));
    byId("above").addEventListener("click", () => lookAt(chosen >= 0 ? rowBox(chosen) : wholeBox(), ABOVE(), 5, 500));
    byId("share").addEventListener("click", (event) => copy(link(), event.target));
    byId("picture").addEventListener("click", () => {
      drawNow(performance.now());
      byId("view").toBlob((blob) => { const save = document.createElement("a"); save.href = URL.createObjectURL(blob); save.download = "subiaco-view.png"; save.click(); });
    });
    ["f-label", "f-class", "f-text"].forEach((id) => byId(id).addEventListener("input", filter));
    byId("rows").addEventListener("click", (event) => { const line = event.target.closest("[data-i]"); if (line) { choose(Number(line.dataset.i), true); } });
    byId("rows").addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key], place = order.indexOf(chosen) + step;
      if (step && order[place] !== undefined) { choose(order[place], true); event.preventDefault(); }
    });
    byId("previous").addEventListener("click", () => { page -= 1; list(); });
    byId("next").addEventListener("click", () => { page += 1; list(); });
    window.addEventListener("hashchange", () => follow(false));
    new ResizeObserver(fit).observe(byId("stage"));
  }
  async function begin(text) {
    try { D = await unpack(text); } catch (error) { fail("This browser cannot unpack the data: please use a browser of 2023 or later."); return; }
    R = D.rows; R.object_id.forEach((id, i) => at.set(id, i));
    const options = (names) => names.map((name) => "<option>" + name + "</option>").join("");
    if (D.simulated) { document.querySelector("h1").textContent = "3D view of simulated surveys"; }
    byId("f-label").innerHTML = '<option value="changed">changed only</option><option value="">everything</option>' + options(D.labels.map((entry) => entry.label));
    byId("f-class").innerHTML = '<option value="">all</option>' + options(D.classes.map((entry) => entry.label));
    const most = window.innerWidth < 760 ? "1000000" : "2000000";
    byId("budget").value = most;
    byId("legend").open = window.innerWidth >= 760;
    filter();
    if (!build()) { return; }
    points.budget = Number(most);
    listen(); fit(); setMode("swipe"); legend(); follow(true);
  }
  window.subiacoViewerData = begin;
  /* For tests and other pages: what the buttons do. */
  window.subiacoViewer = { setMode: setMode, setSwipe: setSwipe, clickAt: clickAt, link: link, row: (id) => choose(at.get(id), true), state: () => ({ mode: mode, swipe: swipe, chosen: chosen < 0 ? null : R.object_id[chosen], points: points.drawnPoints, loaded: points.loadedPoints, settled: points.settled, missing: points.missing, camera: camera.position.toArray(), target: controls.target.toArray() }),
    pixels: () => { drawNow(performance.now()); const gl = renderer.getContext(), found = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight); gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, found); return { width: gl.drawingBufferWidth, height: gl.drawingBufferHeight, data: found }; } };
}());
