// One answer at a time: a chip chooses, and the address says what is chosen, so that it can be sent.
(() => {
  const order = ["peer", "size", "plateaus", "seen"];
  const chips = [...document.querySelectorAll(".chip")];
  const answers = [...document.querySelectorAll(".answer")];
  const named = new Set(answers.map((answer) => answer.id));
  const first = "cma-es-few-plateaus-number";
  if (!named.has(first)) return;
  const chosen = {};
  const choose = (key) => {
    for (const group of order) {
      const keys = chips.filter((chip) => chip.dataset.group === group).map((chip) => chip.dataset.key);
      chosen[group] = keys.find((each) => `-${key}-`.includes(`-${each}-`)) ?? keys[0];
    }
    show();
  };
  const wanted = () => order.map((group) => chosen[group]).join("-");
  const show = () => {
    for (const chip of chips) {
      const on = chosen[chip.dataset.group] === chip.dataset.key;
      chip.classList.toggle("on", on);
      if (on) chip.setAttribute("aria-current", "true");
      else chip.removeAttribute("aria-current");
      chip.href = "#" + order
        .map((group) => (group === chip.dataset.group ? chip.dataset.key : chosen[group]))
        .join("-");
    }
    for (const answer of answers) answer.hidden = answer.id !== wanted();
  };
  const asked = () => decodeURIComponent(location.hash.slice(1));
  for (const chip of chips) {
    chip.addEventListener("click", (event) => {
      event.preventDefault();
      chosen[chip.dataset.group] = chip.dataset.key;
      history.replaceState(null, "", "#" + wanted());
      show();
    });
  }
  addEventListener("hashchange", () => named.has(asked()) && choose(asked()));
  document.documentElement.classList.add("js");
  choose(named.has(asked()) ? asked() : first);
})();
