/* Put into the page of the viewer by test_viewer.py: waits until all is drawn, does what a person does, and
   posts what it saw. */
(async () => {
  const viewer = () => window.subiacoViewer;
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  const ready = () => document.documentElement.dataset.ready;
  const settled = async () => {
    for (let k = 0; k < 1200; k += 1) {
      await wait(50);
      if (document.documentElement.dataset.failed) { return; }
      if (ready()) { await wait(100); if (ready()) { return; } }
    }
  };
  const look = () => {
    const found = viewer().pixels(), lit = [0, 0], colours = new Set();
    for (let y = 0; y < found.height; y += 2) {
      for (let x = 0; x < found.width; x += 2) {
        const i = 4 * (y * found.width + x), [r, g, b] = found.data.slice(i, i + 3);
        colours.add(r << 16 | g << 8 | b);
        if (r + g + b > 90) { lit[x < found.width / 2 ? 0 : 1] += 1; }
      }
    }
    return { lit: lit, colours: colours.size, hash: found.data.reduce((h, v) => (Math.imul(h, 31) + v) | 0, 7) };
  };
  const mode = async (name, share) => {
    viewer().setMode(name);
    if (share !== undefined) { viewer().setSwipe(share); }
    await settled();
    return look();
  };
  const close = () => document.querySelector("#card .close").click();
  const said = {};
  try {
    await settled();
    said.start = viewer().state();
    said.whole = look();
    said.allAfter = await mode("swipe", 0.0);
    said.after = await mode("after");
    said.allBefore = await mode("swipe", 1.0);
    said.before = await mode("before");
    await mode("both");
    document.querySelector(".row[data-i]").click();
    await wait(800);
    await settled();
    said.clicked = viewer().state();
    said.card = document.getElementById("card").textContent;
    said.hash = location.hash;
    close();
    said.closed = viewer().state().chosen;
    viewer().row(__ROW__);
    await wait(800);
    await settled();
    close();
    const area = document.getElementById("view").getBoundingClientRect();
    const hit = viewer().clickAt(area.width / 2, area.height / 2);
    said.hit = hit && hit.object;
    said.picked = viewer().state().chosen;
    said.selected = document.querySelector("[aria-selected=true] b").textContent;
    said.colours = {};
    for (const name of ["change", "class", "height", "intensity", "confidence", "survey"]) {
      const box = document.getElementById("colour");
      box.value = name;
      box.dispatchEvent(new Event("input"));
      await settled();
      said.colours[name] = look().hash;
    }
    said.link = viewer().link();
    said.status = document.getElementById("status").textContent;
  } catch (error) { said.error = String(error) + " " + error.stack; }
  said.failed = document.documentElement.dataset.failed || "";
  fetch("__SAY__", { method: "POST", mode: "no-cors", body: JSON.stringify(said) });
})();
