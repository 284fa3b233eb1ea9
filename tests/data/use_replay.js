// Appended to a page with a replay: moves the slider, changes the view, uses the
// keyboard, and notes in the DOM what the page says then and how many colours it shows.
(async function () {
  const byId = (id) => document.getElementById(id), notes = [];
  const copy = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));

  function change(id, kind, value) {
    byId(id).value = value;
    byId(id).dispatchEvent(new Event(kind));
  }

  async function note(what) {
    await wait(30); // drawing comes a little later
    const world = byId("world-0"), colours = new Set();
    copy.canvas.width = world.width;
    copy.canvas.height = world.height;
    copy.drawImage(world, 0, 0);
    const pixels = copy.getImageData(0, 0, world.width, world.height).data;
    for (let i = 0; i < pixels.length; i += 4 * 37) colours.add((pixels[i] << 16) | (pixels[i + 1] << 8) | pixels[i + 2]);
    notes.push({
      what,
      frame: Number(world.dataset.frame),
      view: world.dataset.view,
      step: byId("now-step").textContent,
      time: byId("now-time").textContent,
      return: Number(byId("now-return-0").textContent),
      cost: Number(byId("now-cost-0").textContent),
      colours: colours.size,
    });
  }

  await note("start");
  change("scrub", "input", "30");
  await note("slider");
  for (const view of ["top", "3d", "follow"]) {
    change("view", "change", view);
    await note(view);
  }
  byId("show-lidar").click();
  byId("show-trail").click();
  await note("bare");
  byId("world-0").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
  await note("key");
  byId("play").click();
  await wait(300);
  byId("play").click();
  await note("played");
  change("scrub", "input", byId("scrub").max);
  await note("end");
  document.body.dataset.notes = JSON.stringify(notes);
})();
