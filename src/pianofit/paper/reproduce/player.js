// One player for each group of sounds; the sounds themselves lie in the page as text.
(() => {
  const sounds = JSON.parse(document.getElementById("sound-data").textContent);
  window.pianofitDecks = {};
  for (const group of document.querySelectorAll(".player")) {
    const play = group.querySelector(".play"), said = group.querySelector(".said");
    const choices = [...group.querySelectorAll(".choice")];
    let deck = null;
    const show = () => {
      play.textContent = deck.playing ? "❚❚ Pause" : "▶ Play";
      choices.forEach((button, index) => button.setAttribute("aria-pressed", String(index === deck.chosen)));
      said.textContent = deck.playing ? `Playing: ${choices[deck.chosen].textContent}` : "";
    };
    const ready = () => {
      deck ??= window.pianofitDecks[group.id] = new Deck(choices.map((button) => sounds[button.dataset.sound]), show);
      return deck;
    };
    play.addEventListener("click", () => ready().toggle());
    choices.forEach((button, index) => button.addEventListener("click", () => {
      ready().choose(index);
      if (!deck.playing) deck.start(0);
    }));
  }
})();
